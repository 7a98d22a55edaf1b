"""From linear light to what a display shows: exposure, view transform, gamma.

Notation: `light` is linear RGB in sRGB primaries, 0 and up, 1 = the sensor's full scale before exposure; `display` is
encoded for an sRGB display, [0, 1].
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.spectral.colour.conversion import linear_to_srgb

ViewTransform = Literal["srgb", "agx"]
VIEW_TRANSFORMS: dict[ViewTransform, str] = {
    "srgb": "sRGB (exact up to white)",
    "agx": "AgX (keeps highlights)",
}
"""Names and what users read."""

# Inset and outset keep saturated colours from clipping in one channel: bright ones fade to white instead. Rows sum to
# 1, so greys stay grey.
_AGX_INSET = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)
_AGX_OUTSET = (
    (1.19687900512017, -0.0980208811401368, -0.0990297440797205),
    (-0.0528968517574562, 1.15190312990417, -0.0989611768448433),
    (-0.0529716355144438, -0.0980434501171241, 1.15107367264116),
)
_AGX_LOG2_BOUNDS = (-12.47393, 4.026069)
"""Light that becomes black and white: 10 stops below and 6.5 above middle grey, 0.18."""

_AGX_CURVE = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)
"""Polynomial of the contrast curve, highest power first."""


def to_display(
    light: Float[Tensor, "*pixels 3"], exposure_ev: float, gamma: float, transform: ViewTransform
) -> Float[Tensor, "*pixels 3"]:
    """Light as a display shows it.

    Args:
        light: Linear RGB.
        exposure_ev: Stops: each doubles the light.
        gamma: Applied last; above 1 lifts what is dark.
        transform: `srgb` clips at white; `agx` compresses 16.5 stops, as film does.
    """
    exposed = light * 2.0**exposure_ev
    shown = _agx(exposed) if transform == "agx" else linear_to_srgb(exposed.clamp(0, 1))
    shown = shown.clamp(0, 1)
    return shown if math.isclose(gamma, 1.0) else shown.pow(1 / gamma)


def _agx(light: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """AgX in its basic look (Sobotka 2022), with the polynomial fit of its curve by Wrensch 2023."""
    low, high = _AGX_LOG2_BOUNDS
    inset = light.clamp(min=0) @ light.new_tensor(_AGX_INSET).T
    x = ((inset.clamp(min=2.0**low).log2() - low) / (high - low)).clamp(0, 1)
    curve = torch.zeros_like(x)
    for coefficient in _AGX_CURVE:
        curve = curve * x + coefficient
    return curve @ light.new_tensor(_AGX_OUTSET).T
