"""Lights: relative power over wavelength, by the name of a standard illuminant or from a CSV file.

Notation: `B` bands. Power is relative, greatest band 1. A band sees the mean of the light over its interval, so that
narrow lines of a lamp count wherever they lie between band centres; in the outer halves of the outermost bands a light
that is known only up to the band centre is taken to continue at its last value.
"""

from __future__ import annotations

import difflib
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode, xyz_matrix
from unmix_plugin.spectral.integrals import integrals_up_to
from unmix_plugin.spectral.library.spectra_csv import TOLERANCE_NM, read_spectra_csv, resample_spectra

_FORMULA_RANGE_NM = (250.0, 3000.0)
"""Where the lights that are defined by a formula are given."""


def parse_light(text: str) -> str | Path:
    """A light as a user writes it: the name of a known one, or the path of a CSV file.

    Raises:
        SpectrumError: neither; the message has the nearest names.

    >>> parse_light("d65")
    'D65'
    """
    spelled = {name.casefold(): name for name in illuminant_names()}
    wanted = text.strip().casefold()
    if wanted in spelled:
        return spelled[wanted]
    if wanted.endswith(".csv"):
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
    """Relative power of a light in each band, greatest 1.

    Args:
        light: A name as `parse_light` gives it, or a CSV file, `wavelength,power`.
        bands: Of the sensor.
        beyond: What to do in bands at whose centres the light is not known: refuse, or hold its outermost value.
    Raises:
        SpectrumError: an unknown name; a file that is missing, malformed or not one light; a light that is not known at
            all bands (the message says by how much) or that is zero there.
    """
    source, power = _table(light)
    if beyond == "refuse":
        try:
            resample_spectra(power, source, bands)
        except SpectrumError as error:
            raise SpectrumError(f"light {light}: {error}") from error
    means = _band_means(power, source, bands)
    if not means.max() > 0:
        raise SpectrumError(f"light {light} has no power in any of {bands}; choose one that shines there")
    return means / means.max()


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
    return _read(light) if isinstance(light, Path) else _tables()[str(parse_light(light))]


def _read(path: Path) -> tuple[Bands, Float64[np.ndarray, " N"]]:
    table = read_spectra_csv(path)
    if len(table.names) != 1:
        raise SpectrumError(
            f"{path}: a light has two columns, wavelength and power; found {len(table.names) + 1}"
        )
    return table.bands, table.spectra[0]


def _band_means(power: Float64[np.ndarray, " N"], source: Bands, bands: Bands) -> Float64[np.ndarray, " B"]:
    """Means of the piecewise linear function through the table over each band's interval, exactly."""
    edges = bands.edges_nm
    [integrals] = integrals_up_to(edges, power[None], source.centers_nm)
    return np.diff(integrals) / np.diff(edges)


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
    tables["A"] = (Bands.of(wavelengths), _incandescent(wavelengths))
    tables["E"] = (Bands.of([low, high]), np.ones(2))
    return tables


def _incandescent(wavelengths_nm: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """CIE illuminant A, 100 at 560 nm: the black body of CIE 15:2018, given there for 300-830 nm, and good beyond."""
    radiation = np.expm1(1.435e7 / (2848.0 * 560.0)) / np.expm1(1.435e7 / (2848.0 * wavelengths_nm))
    return 100.0 * (560.0 / wavelengths_nm) ** 5 * radiation
