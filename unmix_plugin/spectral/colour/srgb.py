"""The sRGB curve on arrays, without PyTorch; `conversion` has it on tensors, with gradients.

Source: IEC 61966-2-1:1999. Nothing is clamped; below 0 the linear piece goes on.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_DARK_LINEAR, _DARK_SRGB = 0.0031308, 0.04045
"""Up to where the curve is a line, as light and as it is encoded."""


def encode_srgb(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Linear light, 1 = full scale, as a display takes it.

    >>> encode_srgb(np.array([0.0, 0.2140, 1.0])).round(3)
    array([0. , 0.5, 1. ])
    """
    bright = 1.055 * np.maximum(linear, _DARK_LINEAR) ** (1 / 2.4) - 0.055
    return np.where(linear <= _DARK_LINEAR, 12.92 * linear, bright)


def decode_srgb(srgb: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The inverse of `encode_srgb`."""
    bright = ((np.maximum(srgb, _DARK_SRGB) + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= _DARK_SRGB, srgb / 12.92, bright)
