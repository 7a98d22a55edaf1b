"""From spectra to colour: lights, one matrix for each sampling of the spectrum, and curves for a display.

Notation: `B` bands; a spectrum is radiance in [0, 1], bands last. `xyz` is CIE 1931 2 degree; `linear_rgb` is linear
light in sRGB primaries; `srgb` is encoded for a display. A matrix has shape (B, 3) and is applied as
`spectra @ matrix`, so colour commutes with mixing and with compositing along a ray. The power of a light is relative,
greatest band 1; a band sees its mean over the band's interval, so that narrow lines of a lamp count wherever they lie,
and a light that is known only up to the outermost band centres is taken to continue at its last value.

White. The flat spectrum 1 (illuminant E at the sensor's full scale) is rendered as the display's white: linear RGB
(1, 1, 1), hence Y = 1. Each colour matching function is integrated between each band's edges, gaps included, and the
three linear RGB columns are then scaled one by one to sum to 1 (a von Kries adaptation whose cones are the sRGB
primaries; it also compensates a channel that a range cut at 450 or 650 nm shortens). The scene's lamp is not divided
out: a yellow lamp stays yellow. This reproduces the sRGB images that come with path-traced cubes, to within 8 bits.

Sensors whose bands cannot tell colours get a false-colour composite instead: see `colour_mode`.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import VISIBLE_RANGE_NM, Bands, integrals_up_to
from unmix_plugin.spectral.library.spectra_csv import TOLERANCE_NM, read_spectra, resample_spectra
from unmix_plugin.spectral.library.spectral_tables import TABLE_SUFFIXES

_FORMULA_RANGE_NM = (250.0, 3000.0)
"""Where the lights that are defined by a formula are given."""
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


def parse_light(text: str) -> str | Path:
    """A light as a user writes it: the name of a known one, or the path of a table of its spectrum.

    >>> parse_light("d65")
    'D65'
    """
    spelled = {name.casefold(): name for name in illuminant_names()}
    wanted = text.strip().casefold()
    if wanted in spelled:
        return spelled[wanted]
    if Path(wanted).suffix[1:] in TABLE_SUFFIXES:
        return Path(text.strip())
    near = [spelled[key] for key in difflib.get_close_matches(wanted, spelled, n=3, cutoff=0.5)]
    hint = f"nearest: {', '.join(near)}" if near else "known are, among others, A, D50, D65, E, FL2, FL11"
    raise SpectrumError(f"there is no light {text!r}; {hint}; or give a .csv file (wavelength,power)")


def illuminant_names() -> tuple[str, ...]:
    """Names of known lights: CIE illuminants (A, C, D50, D65, E, FL1, LED-B1, ...) and measured lamps."""
    return tuple(_tables())


def illuminant_power(
    light: str | Path, bands: Bands, beyond: Literal["refuse", "hold"] = "refuse"
) -> Float64[np.ndarray, " B"]:
    """Relative power of a light in each band, greatest 1, as `power_in_bands` finds it.

    Args:
        light: A name as `parse_light` gives it, or a table, `wavelength,power`.
        beyond: What to do in bands at whose centres the light is not known: refuse, or hold its outermost value.
    Raises:
        SpectrumError: an unknown name, a file that is not one light, or a light that is zero or unknown at bands.
    """
    source, power = _table(light)
    try:
        means = power_in_bands(power, source, bands, beyond)
    except SpectrumError as error:
        raise SpectrumError(f"light {light}: {error}") from error
    if not means.max() > 0:
        raise SpectrumError(f"light {light} has no power in any of {bands}; choose one that shines there")
    return means / means.max()


def power_in_bands(
    power: Float64[np.ndarray, " N"],
    source: Bands,
    bands: Bands,
    beyond: Literal["refuse", "hold"] = "refuse",
) -> Float64[np.ndarray, " B"]:
    """A light's mean power in each band, from a table: that of the line through it over the band's interval, exactly.

    A table at the centres of the bands, but for rounding, has such means already and is taken as it is. One that does
    not reach all centres is refused, or its outermost value held.
    """
    if len(source) == len(bands) and (abs(source.centers_nm - bands.centers_nm) <= TOLERANCE_NM).all():
        return power
    if beyond == "refuse":
        resample_spectra(power, source, bands)
    [integrals] = integrals_up_to(bands.intervals_nm.ravel(), power[None], source.centers_nm)
    return np.diff(integrals.reshape(-1, 2))[:, 0] / bands.widths_nm


def covered_bands(light: str | Path, bands: Bands) -> Bool[np.ndarray, " B"]:
    """Bands at whose centres a light is known; errors are those of `illuminant_power`."""
    source = _table(light)[0].centers_nm
    return (bands.centers_nm >= source[0] - TOLERANCE_NM) & (bands.centers_nm <= source[-1] + TOLERANCE_NM)


def brightness(power: Float64[np.ndarray, " B"], bands: Bands) -> float:
    """How bright a perfect white is in a light: its luminance where the bands see colours, otherwise its mean
    radiance."""
    if colour_mode(bands) == "true-colour":
        return float(power @ xyz_matrix(bands).double().numpy()[:, 1])
    return float(power @ bands.widths_nm / bands.widths_nm.sum())


def _table(light: str | Path) -> tuple[Bands, Float64[np.ndarray, " N"]]:
    if not isinstance(light, Path):
        return _tables()[str(parse_light(light))]
    table = read_spectra(light)
    if len(table.names) != 1:
        raise SpectrumError(
            f"{light}: a light has two columns, wavelength and power; found {len(table.names) + 1}"
        )
    return table.bands, table.spectra[0]


@lru_cache(maxsize=1)
def _tables() -> dict[str, tuple[Bands, Float64[np.ndarray, " N"]]]:
    """Every known light as colour-science has it, but A and E as their definitions, which no table cuts off."""
    # Guarded because importing colour-science changes how NumPy prints.
    with np.printoptions():
        from colour.colorimetry import SDS_ILLUMINANTS, SDS_LIGHT_SOURCES
    tables = {
        name: (Bands.of(found.wavelengths), np.asarray(found.values, dtype=np.float64))
        for group in (SDS_LIGHT_SOURCES, SDS_ILLUMINANTS)
        for name, found in group.items()
    }
    low, high = _FORMULA_RANGE_NM
    wavelengths = np.arange(low, high + 1, 5.0)
    # CIE illuminant A, 100 at 560 nm: the black body of CIE 15:2018, given there for 300-830 nm, and good beyond.
    radiation = np.expm1(1.435e7 / (2848.0 * 560.0)) / np.expm1(1.435e7 / (2848.0 * wavelengths))
    tables["A"] = (Bands.of(wavelengths), 100.0 * (560.0 / wavelengths) ** 5 * radiation)
    tables["E"] = (Bands.of([low, high]), np.ones(2))
    return tables


def colour_mode(bands: Bands) -> Literal["true-colour", "false-colour"]:
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
    (low, high), parts = bands.ranges_nm.T, []
    for name, first, last, weights in zip(
        ("red", "green", "blue"), thirds[-2::-1], thirds[:0:-1], _thirds_of_range(bands).T, strict=True
    ):
        part = f"{first:.0f}-{last:.0f} nm"
        if not ((low < last) & (high > first)).any():  # a gap, over which those beside it reach
            part = f"of bands at {' and '.join(f'{nm:.0f}' for nm in bands.centers_nm[weights > 0])} nm"
        parts.append(f"{name} {part}")
    return "false colour: " + ", ".join(parts)


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
    functions are those of CIE 15:2018 at 1 nm (cie_1931_2_degree.csv); some band has to reach into 360-830 nm.
    """
    return torch.tensor(_xyz_weights(bands), dtype=dtype)


def band_composite_matrix(bands: Bands, wavelengths_nm: Sequence[float | int]) -> Float[Tensor, "B 3"]:
    """Matrix that shows three chosen bands as red, green and blue: the nearest to each wavelength, unscaled.

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
    """Encode linear light for a display (IEC 61966-2-1:1999; below 0 the linear piece goes on, gradients are finite).

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
    with (resources.files("unmix_plugin.spectral.colour") / "cie_1931_2_degree.csv").open(
        encoding="utf-8"
    ) as file:
        wavelengths, *columns = np.loadtxt(file, delimiter=",", skiprows=1, unpack=True)
    values = np.stack(columns, axis=1)
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


def agx(light: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
    """Linear light in sRGB primaries, 0 and up, as AgX encodes it for an sRGB display: in about [0, 1], which saturated
    colours may leave a little. Differentiable between its black and its white."""
    low, high = _LOG2_BOUNDS
    inset = light.clamp(min=0) @ light.new_tensor(_INSET).T
    x = ((inset.clamp(min=2.0**low).log2() - low) / (high - low)).clamp(0, 1)
    curve = torch.zeros_like(x)
    for coefficient in _CURVE:
        curve = curve * x + coefficient
    return curve @ light.new_tensor(_OUTSET).T
