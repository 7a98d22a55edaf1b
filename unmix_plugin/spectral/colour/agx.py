"""AgX in its basic look: a tone curve that compresses 16.5 stops as film does, and lets bright colours fade to white.

Source: Sobotka 2022; the polynomial fit of its contrast curve is Wrensch's, 2023.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Inset and outset keep saturated colours from clipping in one channel: bright ones fade to white instead. Rows sum to
# 1, so greys stay grey.
_INSET = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)
_OUTSET = (
    (1.19687900512017, -0.0980208811401368, -0.0990297440797205),
    (-0.0528968517574562, 1.15190312990417, -0.0989611768448433),
    (-0.0529716355144438, -0.0980434501171241, 1.15107367264116),
)
_LOG2_BOUNDS = (-12.47393, 4.026069)
"""Light that becomes black and white: 10 stops below and 6.5 above middle grey, 0.18."""

_CURVE = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)
"""Polynomial of the contrast curve, highest power first."""


def agx(light: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """Light as AgX encodes it for an sRGB display; differentiable between its black and its white.

    Args:
        light: Linear RGB in sRGB primaries, 0 and up.
    Returns:
        About [0, 1]; saturated colours may leave it a little.
    """
    low, high = _LOG2_BOUNDS
    inset = light.clamp(min=0) @ light.new_tensor(_INSET).T
    x = ((inset.clamp(min=2.0**low).log2() - low) / (high - low)).clamp(0, 1)
    curve = torch.zeros_like(x)
    for coefficient in _CURVE:
        curve = curve * x + coefficient
    return curve @ light.new_tensor(_OUTSET).T
