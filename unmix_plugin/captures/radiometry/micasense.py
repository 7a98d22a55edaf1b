"""MicaSense RedEdge and Altum: radiance in W/m2/sr/nm.

    L = 1 / V(r) * a1 / (gain * exposure) * (p - pBL) / 2^bits / (1 + a2 y / exposure - a3 y)

with V a polynomial of the distance to the vignetting centre, gain = ISO speed / 100, and pBL the mean black level.
Source: MicaSense, RedEdge camera radiometric calibration model.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import XmpTags, tag_numbers
from unmix_plugin.captures.radiometry.model import (
    RadiometricModel,
    radial_polynomial,
    require_exif,
    require_numbers,
    stored_range,
)
from unmix_plugin.captures.spectral_file import SpectralFile

SATURATED = 65520.0
"""The sensor has 12 bits, stored in the upper ones of 16."""
FAULTY_EXPOSURE_S, TRUE_EXPOSURE_S = 1.0 / 6329.0, 0.000274
"""What old firmware of the RedEdge wrote, and what it meant."""


def is_maker(tags: XmpTags) -> bool:
    """Whether a file carries this calibration."""
    return tag_numbers(tags, "RadiometricCalibration") is not None


def read_model(file: SpectralFile, tags: XmpTags, exif: dict[str, Any]) -> RadiometricModel:
    """The calibration of a file.

    Raises:
        CaptureError: a tag is absent or of the wrong size.
    """
    a1, a2, a3 = require_numbers(
        file, "XMP RadiometricCalibration", tag_numbers(tags, "RadiometricCalibration"), 3
    )
    exposure = _exposure_s(file, exif)
    iso = require_exif(file, exif, "ISOSpeed", "ISOSpeedRatings", "PhotographicSensitivity")
    levels = exif.get("BlackLevel") or tag_numbers(tags, "DarkRowValue") or [0.0]
    centre = require_numbers(file, "XMP VignettingCenter", tag_numbers(tags, "VignettingCenter"), 2)
    polynomial = tag_numbers(tags, "VignettingPolynomial")
    polynomial = require_numbers(file, "XMP VignettingPolynomial", polynomial, 6)
    gain = a1 / (0.01 * iso * exposure) / stored_range(exif)

    def factor_of(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        rows = 1.0 + a2 * y / exposure - a3 * y
        return gain / (radial_polynomial(polynomial, centre, y, x) * rows)

    return RadiometricModel(
        "MicaSense", "W/m2/sr/nm", float(np.mean(levels)), SATURATED, factor_of, _irradiance(tags)
    )


def _exposure_s(file: SpectralFile, exif: dict[str, Any]) -> float:
    exposure = require_exif(file, exif, "ExposureTime")
    is_faulty = exif.get("Model") == "RedEdge" and abs(exposure - FAULTY_EXPOSURE_S) < 1e-6
    return TRUE_EXPOSURE_S if is_faulty else exposure


def _irradiance(tags: XmpTags) -> float | None:
    """W/m2/nm; horizontal where the file has it."""
    found = tag_numbers(tags, "HorizontalIrradiance", "SpectralIrradiance")
    scale = tag_numbers(tags, "IrradianceScaleToSIUnits")
    default = 0.01 if tag_numbers(tags, "HorizontalIrradiance") else 1.0
    return None if found is None else found[0] * (scale[0] if scale else default)
