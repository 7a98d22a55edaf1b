"""A colour for each material: its own where that can be told from the others, otherwise the nearest that can.

Notation: `K` materials, `N` colours; `lab` is CIE 1976 L*a*b* of sRGB colours under D65, in which equal distances look
about equally different.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    XYZ_TO_LINEAR_SRGB,
    linear_to_srgb,
    rgb_matrix,
    srgb_to_linear,
)

_LIGHTNESS_BOUNDS = (30.0, 85.0)
"""L* of colours that stand out from a light page and from black text."""

_DISTANCE = 32.0
"""Distance in L*a*b* of the colours of any two materials, as long as there is room for it."""

_LEVELS = 21
"""Steps of each sRGB channel among which colours are looked for."""


def own_colours(spectra: Float[Tensor, "K B"], bands: Bands) -> Float64[np.ndarray, "K 3"]:
    """The sRGB colour of each spectrum, [0, 1]: what a surface of it looks like, or its false colour."""
    linear = spectra.detach().cpu().double().clamp(min=0) @ rgb_matrix(bands, torch.float64)
    return linear_to_srgb(linear.clamp(0, 1)).numpy()


def distinct_colours(own_srgb: Float[np.ndarray, "K 3"]) -> Float64[np.ndarray, "K 3"]:
    """sRGB colours near the given ones, any two well apart, all visible on a light page; the first have first choice.

    >>> distinct_colours(np.array([[0.8, 0.2, 0.2], [0.2, 0.3, 0.8]])).round(2)
    array([[0.8, 0.2, 0.2],
           [0.2, 0.3, 0.8]])
    """
    wanted = _lab(own_srgb)
    distance = _DISTANCE
    while True:
        chosen = _choose_apart(wanted, distance)
        if chosen is not None:
            return chosen
        distance *= 0.9


def _choose_apart(wanted: Float64[np.ndarray, "K 3"], distance: float) -> Float64[np.ndarray, "K 3"] | None:
    """For each wanted colour in turn the nearest that is `distance` from those before; None if one has no place."""
    srgb, lab = _visible_colours()
    is_free = np.ones(len(lab), dtype=bool)
    chosen: list[int] = []
    for colour in wanted:
        if not is_free.any():
            return None
        to_wanted = np.where(is_free, np.linalg.norm(lab - colour, axis=1), np.inf)
        chosen.append(int(to_wanted.argmin()))
        is_free &= np.linalg.norm(lab - lab[chosen[-1]], axis=1) >= distance
    return srgb[chosen]


@lru_cache(maxsize=1)
def _visible_colours() -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Colours to choose from, as sRGB and as L*a*b*."""
    levels = np.linspace(0, 1, _LEVELS)
    srgb = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    lab = _lab(srgb)
    low, high = _LIGHTNESS_BOUNDS
    visible = (lab[:, 0] >= low) & (lab[:, 0] <= high)
    return srgb[visible], lab[visible]


def _lab(srgb: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """CIE 1976 L*a*b* of sRGB colours."""
    linear = srgb_to_linear(torch.from_numpy(np.asarray(srgb, dtype=np.float64))).numpy()
    to_xyz = np.linalg.inv(XYZ_TO_LINEAR_SRGB)
    ratio = (linear @ to_xyz.T) / to_xyz.sum(axis=1)
    root = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = root.T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)
