"""From spectra to colour, as one matrix for each sampling of the spectrum.

Notation: `B` bands; a spectrum is radiance in [0, 1], bands last. `xyz` is CIE 1931 2 degree; `linear_rgb` is linear
light in sRGB primaries; `srgb` is encoded for a display. A matrix has shape (B, 3) and is applied as
`spectra @ matrix`, so colour commutes with mixing and with compositing along a ray.

White. The flat spectrum 1 (illuminant E at the sensor's full scale) is rendered as the display's white: linear RGB
(1, 1, 1), hence Y = 1. Each colour matching function is integrated over each band's interval, and the three linear RGB
columns are then scaled one by one to sum to 1 (a von Kries adaptation whose cones are the sRGB primaries; it also
compensates a channel that a range cut at 450 or 650 nm shortens). The scene's lamp is not divided out: a yellow lamp
stays yellow. Of the conventions tried (no adaptation, Bradford from E or from the lamp to D65, XYZ scaling), this one
reproduces the sRGB images that come with path-traced cubes, to within their 8 bits.

Sensors whose bands cannot tell colours get a false-colour composite instead: see `colour_mode`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import VISIBLE_RANGE_NM, Bands

ColourMode = Literal["true-colour", "false-colour"]

XYZ_TO_LINEAR_SRGB = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
"""IEC 61966-2-1:1999, D65; rows are R, G, B."""

_SRGB_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Y of the sRGB primaries (IEC 61966-2-1:1999)."""

_PRIMARY_REGIONS_NM = ((VISIBLE_RANGE_NM[0], 500.0), (500.0, 600.0), (600.0, VISIBLE_RANGE_NM[1]))
"""A sensor needs a band in each to tell blue, green and red apart."""

_MIN_WHITE = 0.2
"""Smallest channel of unscaled white, relative to its luminance. Below it, a sensor hardly sees that primary, and
scaling it to white would amplify noise."""


def colour_mode(bands: Bands) -> ColourMode:
    """Whether `rgb_matrix` gives colours as an eye would see them, or a false-colour composite.

    True colour takes a band centre in each of 380-500, 500-600 and 600-780 nm, and a noticeable response of each sRGB
    primary to white light. Anything else (near infrared, one narrow range, one or two bands) is false colour.

    >>> colour_mode(Bands.of([450, 550, 650])), colour_mode(Bands.of([800, 900, 1000]))
    ('true-colour', 'false-colour')
    """
    centers = bands.centers_nm
    if not all(((centers >= low) & (centers <= high)).any() for low, high in _PRIMARY_REGIONS_NM):
        return "false-colour"
    white = _unscaled_rgb_weights(bands).sum(axis=0)
    return "true-colour" if white.min() >= _MIN_WHITE * (_SRGB_LUMINANCE @ white) else "false-colour"


def describe_colour(bands: Bands) -> str:
    """One phrase for legends and logs: what red, green and blue of `rgb_matrix` mean for these bands.

    >>> describe_colour(Bands.of([700, 800, 900, 1000]))
    'false colour: red 917-1050 nm, green 783-917 nm, blue 650-783 nm'
    """
    if colour_mode(bands) == "true-colour":
        return "true colour: CIE 1931 2 degree observer, flat spectrum shown as white"
    thirds = np.linspace(bands.edges_nm[0], bands.edges_nm[-1], 4)
    names = [
        f"{name} {thirds[i]:.0f}-{thirds[i + 1]:.0f} nm" for i, name in enumerate(("blue", "green", "red"))
    ]
    return "false colour: " + ", ".join(names[::-1])


def rgb_matrix(bands: Bands, dtype: torch.dtype = torch.float32) -> Float[Tensor, "B 3"]:
    """Matrix from spectra to linear RGB in sRGB primaries, on the CPU; columns sum to 1, so that flat 1 is white.

    For true-colour bands saturated colours may lie outside the sRGB gamut, below 0 or above 1: clamp after encoding.
    For false-colour bands red, green and blue are the means over the longest, middle and shortest third of the
    covered range (see `describe_colour`), never negative.
    """
    if colour_mode(bands) == "true-colour":
        weights = _unscaled_rgb_weights(bands)
        weights = weights / weights.sum(axis=0)
    else:
        weights = _thirds_of_range(bands)
    return torch.tensor(weights, dtype=dtype)


def xyz_matrix(bands: Bands, dtype: torch.dtype = torch.float32) -> Float[Tensor, "B 3"]:
    """Matrix from spectra to CIE 1931 2 degree XYZ, on the CPU; flat 1 has Y = 1 and the chromaticity of illuminant E.

    Relative to the covered range: a sensor that ends at 650 nm is normalised by what it sees of Y. The colour matching
    functions are those of CIE 15:2018 at 1 nm, as colour-science gives them.

    Raises:
        SpectrumError: no band reaches into 360-830 nm, where the colour matching functions are.
    """
    return torch.tensor(_xyz_weights(bands), dtype=dtype)


def band_composite_matrix(bands: Bands, wavelengths_nm: Sequence[float | int]) -> Float[Tensor, "B 3"]:
    """Matrix that shows three chosen bands as red, green and blue: the nearest to each wavelength, unscaled.

    Raises:
        SpectrumError: not three wavelengths, or one that no band covers.

    >>> band_composite_matrix(Bands.of([550, 650, 860]), (860, 650, 550))
    tensor([[0., 0., 1.],
            [0., 1., 0.],
            [1., 0., 0.]])
    """
    if len(wavelengths_nm) != 3:
        raise SpectrumError(
            f"a false-colour composite needs three wavelengths (red, green, blue); found {len(wavelengths_nm)}"
        )
    matrix = torch.zeros(len(bands), 3)
    for channel, wavelength_nm in enumerate(wavelengths_nm):
        matrix[bands.nearest(wavelength_nm), channel] = 1
    return matrix


def linear_to_srgb(linear_rgb: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Encode linear light for a display (IEC 61966-2-1:1999; below 0 the linear piece goes on).

    Increasing everywhere, gradients finite, nothing clamped.

    >>> linear_to_srgb(torch.tensor([0.0, 0.2140, 1.0]))
    tensor([0.0000, 0.5000, 1.0000])
    """
    threshold = 0.0031308
    # The power sees nothing below the threshold: its infinite slope at 0 times the mask's 0 would be a NaN gradient.
    power = 1.055 * linear_rgb.clamp(min=threshold) ** (1 / 2.4) - 0.055
    return torch.where(linear_rgb <= threshold, 12.92 * linear_rgb, power)


def srgb_to_linear(srgb: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Decode sRGB values (1 = full scale) to linear light: the inverse of `linear_to_srgb`, gradients finite."""
    threshold = 0.04045
    power = ((srgb.clamp(min=threshold) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= threshold, srgb / 12.92, power)


@lru_cache(maxsize=1)
def _cumulative_cmfs() -> tuple[Float64[np.ndarray, " edges"], Float64[np.ndarray, "edges 3"]]:
    """Wavelengths in nm, and the integrals of the colour matching functions from 360 nm up to them."""
    # Imported here because colour-science takes more than a second, and guarded because it changes how NumPy prints.
    with np.printoptions():
        from colour.colorimetry import MSDS_CMFS

    observer = MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    wavelengths, values = np.asarray(observer.wavelengths), np.asarray(observer.values)
    steps = np.diff(wavelengths)[:, None] * (values[1:] + values[:-1]) / 2
    return wavelengths, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


@lru_cache(maxsize=32)
def _xyz_weights(bands: Bands) -> Float64[np.ndarray, "B 3"]:
    wavelengths, cumulative = _cumulative_cmfs()
    at_edges = np.stack([np.interp(bands.edges_nm, wavelengths, column) for column in cumulative.T], axis=1)
    weights = np.diff(at_edges, axis=0)
    if weights[:, 1].sum() <= 0:
        raise SpectrumError(f"{bands} hold no visible light; XYZ needs bands inside 360-830 nm")
    return weights / weights[:, 1].sum()


def _unscaled_rgb_weights(bands: Bands) -> Float64[np.ndarray, "B 3"]:
    return _xyz_weights(bands) @ XYZ_TO_LINEAR_SRGB.T


def _thirds_of_range(bands: Bands) -> Float64[np.ndarray, "B 3"]:
    """Share of each third of the range that each band's interval fills; longest third first."""
    low, high = bands.edges_nm[:-1, None], bands.edges_nm[1:, None]
    thirds = np.linspace(bands.edges_nm[0], bands.edges_nm[-1], 4)
    overlaps = np.minimum(high, thirds[1:]) - np.maximum(low, thirds[:-1])
    overlaps = overlaps.clip(min=0)[:, ::-1]
    return overlaps / overlaps.sum(axis=0)
