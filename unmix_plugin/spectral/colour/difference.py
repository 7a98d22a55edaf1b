"""How different colours look: CIE L*a*b* under a light, and CIEDE2000.

Notation: `B` bands, `*shape` any leading axes. A difference of 1 is just noticeable side by side, 2 to 3 at a glance.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    XYZ_TO_LINEAR_SRGB,
    linear_to_srgb,
    srgb_to_linear,
    xyz_matrix,
)


def reflectance_to_lab(
    reflectance: Float[np.ndarray, "*shape B"], light: Float[np.ndarray, " B"], bands: Bands
) -> Float64[np.ndarray, "*shape 3"]:
    """L*a*b* of surfaces to an eye that is adapted to the light: a perfect white is (100, 0, 0) under every light.

    Raises:
        SpectrumError: the bands hold no visible light.
    """
    lit = light[:, None] * xyz_matrix(bands, torch.float64).numpy()
    return xyz_to_lab(reflectance @ lit, lit.sum(axis=0))


def srgb_to_lab(srgb: Float[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """L*a*b* of sRGB colours in [0, 1] on a display whose white is D65."""
    to_xyz = np.linalg.inv(XYZ_TO_LINEAR_SRGB)
    linear = srgb_to_linear(torch.from_numpy(np.asarray(srgb, dtype=np.float64))).numpy()
    return xyz_to_lab(linear @ to_xyz.T, to_xyz.sum(axis=1))


def lab_to_srgb(lab: Float[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """sRGB of L*a*b* colours on a display whose white is D65; those outside its gamut are clamped to [0, 1]."""
    lightness, a, b = np.moveaxis(np.asarray(lab, dtype=np.float64), -1, 0)
    y = (lightness + 16) / 116
    root = np.stack([y + a / 500, y, y - b / 200], axis=-1)
    ratio = np.where(root > 6 / 29, root**3, 3 * (6 / 29) ** 2 * (root - 4 / 29))
    xyz = ratio * np.linalg.inv(XYZ_TO_LINEAR_SRGB).sum(axis=1)
    linear = np.clip(xyz @ XYZ_TO_LINEAR_SRGB.T, 0, 1)
    return linear_to_srgb(torch.from_numpy(linear)).numpy()


def xyz_to_lab(
    xyz: Float[np.ndarray, "*shape 3"], white: Float[np.ndarray, "3"]
) -> Float64[np.ndarray, "*shape 3"]:
    """CIE 1976 L*a*b* (CIE 15:2018, section 8.2.1) of tristimulus values in the unit of `white`'s."""
    ratio = np.asarray(xyz, dtype=np.float64) / white
    root = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def ciede2000(
    first: Float[np.ndarray, "*shape 3"], second: Float[np.ndarray, "*shape 3"]
) -> Float64[np.ndarray, "*shape"]:
    """CIEDE2000 colour difference of L*a*b* colours, all weights 1.

    Source:
        Sharma, Wu and Dalal 2005, The CIEDE2000 color-difference formula; computed by colour-science.
    """
    # Guarded because importing colour-science changes how NumPy prints.
    with np.printoptions():
        from colour.difference import delta_E_CIE2000

    return np.asarray(delta_E_CIE2000(first, second), dtype=np.float64)
