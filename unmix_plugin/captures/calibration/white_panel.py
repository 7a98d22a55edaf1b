"""How much a white panel reflects, and whether its image can serve."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.calibration.band_choice import LEAST_WHITE
from unmix_plugin.captures.calibration.calibration import WhiteReference
from unmix_plugin.captures.calibration.references import Reference
from unmix_plugin.errors import CaptureError, ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv

MOST_SATURATED = 0.5
"""Share of a white reference's values at the detector's top at which it can't serve."""


def panel_reflectance(text: str, wavelengths_nm: Float64[np.ndarray, " B"]) -> Float64[np.ndarray, " B"]:
    """Reflectance of the panel at each band, from a number or a CSV file (wavelength,reflectance).

    Raises:
        ConfigError: neither, or not above 0 and at most 1.5.
        SpectrumError: the file is damaged or does not reach all bands.
    """
    try:
        values = np.full(len(wavelengths_nm), float(text))
    except ValueError:
        if not Path(text).is_file():
            raise ConfigError(
                f"--white-reflectance {text}: neither a number nor a file; expected 0.99 or a CSV file"
            ) from None
        table = read_spectra_csv(Path(text))
        if len(table.names) != 1:
            raise SpectrumError(
                f"{text}: expected one column beside 'wavelength'; found {len(table.names)}"
            ) from None
        order = np.argsort(wavelengths_nm, kind="stable")
        distinct, back = np.unique(wavelengths_nm[order], return_inverse=True)
        values = np.empty(len(wavelengths_nm))
        values[order] = table.resampled(Bands(distinct)).spectra[0][back]
    if not (np.isfinite(values).all() and values.min() > 0.0 and values.max() <= 1.5):
        raise ConfigError(
            f"--white-reflectance {text} is {values.min():g} to {values.max():g}; expected a reflectance above 0, such "
            "as 0.99 (per cent are divided by 100 first)"
        )
    return values


def white_reference(
    reference: Reference, dark: Reference | None, reflectance: Float64[np.ndarray, " B"]
) -> WhiteReference:
    """A white reference that is brighter than the dark.

    Raises:
        CaptureError: it is not.
    """
    light = panel_signal(reference, dark)
    if not (light > 0).mean() > 0.5:
        dark_name = "0" if dark is None else f"the dark frame {dark.file.path}"
        raise CaptureError(
            f"{reference.file.path}: the white reference is not brighter than {dark_name} in "
            f"{(light <= 0).mean():.0%} of its bands; are white and dark swapped?"
        )
    return WhiteReference(reference, reflectance)


def panel_signal(reference: Reference, dark: Reference | None) -> Float64[np.ndarray, " B"]:
    """Mean counts of the white above dark at each band of the file."""
    signal = reference.mean.astype(np.float64).mean(axis=(0, 1))
    return signal if dark is None else signal - dark.mean.astype(np.float64).mean(axis=(0, 1))


def too_dark(signal: Float64[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
    """Bands in which there is hardly any light on the panel."""
    return signal < LEAST_WHITE * signal.max()


def refuse_saturated(reference: Reference, saturation: float | None) -> None:
    """Refuse a white reference that is mostly at the detector's top.

    Raises:
        CaptureError: it is.
    """
    if saturation is None:
        return
    share = float((reference.mean >= saturation).mean())
    if share > MOST_SATURATED:
        raise CaptureError(
            f"{reference.file.path}: {share:.0%} of the white reference is saturated ({saturation:g} and above); take "
            "it again with a shorter exposure"
        )
