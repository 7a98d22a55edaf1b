"""How different colours look, and pairs of surfaces that look alike in one light and differ in another (metamerism).

Notation: `B` bands, `N` surfaces, `L` lights, `P` pairs, `*shape` any leading axes. Colours are CIE L*a*b* as an eye
adapted to each light sees them; their differences are CIEDE2000: 1 is just noticeable side by side, 2 to 3 at a
glance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import XYZ_TO_LINEAR_SRGB, colour_mode, xyz_matrix
from unmix_plugin.spectral.colour.srgb import decode_srgb, encode_srgb


def reflectance_to_lab(
    reflectance: Float[np.ndarray, "*shape B"], light: Float[np.ndarray, " B"], bands: Bands
) -> Float64[np.ndarray, "*shape 3"]:
    """L*a*b* of surfaces to an eye that is adapted to the light: a perfect white is (100, 0, 0) under every light."""
    lit = light[:, None] * xyz_matrix(bands, torch.float64).numpy()
    return _xyz_to_lab(reflectance @ lit, lit.sum(axis=0))


def srgb_to_lab(srgb: Float[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """L*a*b* of sRGB colours in [0, 1] on a display whose white is D65."""
    to_xyz = np.linalg.inv(XYZ_TO_LINEAR_SRGB)
    return _xyz_to_lab(decode_srgb(srgb) @ to_xyz.T, to_xyz.sum(axis=1))


def lab_to_srgb(lab: Float[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """sRGB of L*a*b* colours on a display whose white is D65; those outside its gamut are clamped to [0, 1]."""
    lightness, a, b = np.moveaxis(np.asarray(lab, dtype=np.float64), -1, 0)
    y = (lightness + 16) / 116
    root = np.stack([y + a / 500, y, y - b / 200], axis=-1)
    ratio = np.where(root > 6 / 29, root**3, 3 * (6 / 29) ** 2 * (root - 4 / 29))
    xyz = ratio * np.linalg.inv(XYZ_TO_LINEAR_SRGB).sum(axis=1)
    return encode_srgb(np.clip(xyz @ XYZ_TO_LINEAR_SRGB.T, 0, 1))


def _xyz_to_lab(
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
        Sharma, Wu and Dalal 2005, The CIEDE2000 color-difference formula; computed by scikit-image, which is imported
        in a fifth of the time that colour-science takes.
    """
    from skimage.color import deltaE_ciede2000

    return np.asarray(deltaE_ciede2000(first, second), dtype=np.float64)


@dataclass(frozen=True)
class MetamericPair:
    """Two surfaces and how different they look."""

    first: int
    second: int
    differences: tuple[float, ...]
    """CIEDE2000 in each light."""

    @property
    def alike_in(self) -> int:
        """The light in which they look most alike."""
        return int(np.argmin(self.differences))

    @property
    def different_in(self) -> int:
        """The light in which they differ most."""
        return int(np.argmax(self.differences))


def metameric_pairs(
    reflectance: Float64[np.ndarray, "N B"],
    lights: Float64[np.ndarray, "L B"],
    bands: Bands,
    alike: float = 2.0,
    different: float = 4.0,
) -> list[MetamericPair]:
    """All pairs of surfaces that look alike in one of the lights (relative power) and different in another, those that
    differ most first; `alike` and `different` are the CIEDE2000 up to and from which they look so.

    Raises:
        SpectrumError: fewer than two lights or one that is no white to an eye, bands in which colours can't be told,
            or thresholds the wrong way round.
    """
    if len(lights) < 2:
        raise SpectrumError(f"metamerism needs at least two lights; found {len(lights)}")
    if colour_mode(bands) != "true-colour":
        raise SpectrumError(
            f"{bands} can't tell colours apart as an eye does, so nothing is known of metamerism"
        )
    if not 0 <= alike < different:
        raise SpectrumError(
            "the difference of surfaces that look alike must be below that of those that look different; "
            f"found {alike:g} and {different:g}"
        )
    whites = lights @ xyz_matrix(bands, torch.float64).numpy()
    if not (whites > 0).all():
        light = int(np.argmin((whites > 0).all(axis=1)))
        raise SpectrumError(
            f"light {light + 1} of {len(lights)} has no power where the eye tells blue, green and red apart, so no eye "
            "adapts to it; leave it out"
        )
    first, second = np.triu_indices(len(reflectance), k=1)
    labs = [reflectance_to_lab(reflectance, light, bands) for light in lights]
    differences = np.stack([ciede2000(lab[first], lab[second]) for lab in labs], axis=1)
    chosen = (differences.min(axis=1) <= alike) & (differences.max(axis=1) >= different)
    order = np.flatnonzero(chosen)[np.argsort(-differences[chosen].max(axis=1), kind="stable")]
    return [
        MetamericPair(int(first[row]), int(second[row]), tuple(differences[row].tolist())) for row in order
    ]
