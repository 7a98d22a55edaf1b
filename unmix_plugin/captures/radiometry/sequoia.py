"""Parrot Sequoia: radiance in a unit of its own, the same for its four bands.

    I = f^2 (p - B) / (A * exposure * iso + C) / V(x / W, y / H)

with the sensor model A, B, C and V a polynomial in two variables whose powers the file lists.
Source: Parrot, SEQ-AN-01 (pixel value to irradiance) and SEQ-AN-02 (vignetting).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import XmpTags, tag_numbers
from unmix_plugin.captures.radiometry.model import (
    RadiometricModel,
    require_exif,
    require_numbers,
    stored_range,
)
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

SATURATED = 65472.0
"""The sensor has 10 bits, stored in the upper ones of 16."""
SATURATED_10_BITS = 1023.0
GREATEST_POWER = 20


def is_maker(tags: XmpTags) -> bool:
    """Whether a file carries this calibration."""
    return tag_numbers(tags, "SensorModel") is not None


def read_model(file: SpectralFile, tags: XmpTags, exif: dict[str, Any]) -> RadiometricModel:
    """The calibration of a file.

    Raises:
        CaptureError: a tag is absent or of the wrong size.
    """
    a, b, c = require_numbers(file, "XMP SensorModel", tag_numbers(tags, "SensorModel"), 3)
    exposure, f_number = require_exif(file, exif, "ExposureTime"), require_exif(file, exif, "FNumber")
    iso = require_exif(file, exif, "ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed")
    vignetting = _vignetting(file, tags)
    height, width = file.shape[:2]
    gain = f_number**2 / (a * exposure * iso + c)

    def factor_of(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        across = np.vander(x[0] / width, vignetting.shape[0], increasing=True)
        down = np.vander(y[:, 0] / height, vignetting.shape[1], increasing=True)
        return gain / (down @ vignetting.T @ across.T)

    saturated = SATURATED_10_BITS if stored_range(exif) == 2.0**10 else SATURATED
    return RadiometricModel("Parrot Sequoia", "relative", b, saturated, factor_of)


def _vignetting(file: SpectralFile, tags: XmpTags) -> np.ndarray:
    """Coefficients c[n, m] of x^n y^m; a 1 alone where the file has no polynomial."""
    powers = tag_numbers(tags, "VignettingPolynomial2DName")
    if powers is None:
        return np.ones((1, 1))
    powers = [int(power) for power in powers]
    if len(powers) % 2 or not all(0 <= power <= GREATEST_POWER for power in powers):
        raise CaptureError(
            f"{file.path}: the tag XMP VignettingPolynomial2DName holds {powers}; expected pairs of powers from 0 to "
            f"{GREATEST_POWER}"
        )
    numbers = require_numbers(
        file, "XMP VignettingPolynomial2D", tag_numbers(tags, "VignettingPolynomial2D"), len(powers) // 2
    )
    coefficients = np.zeros((max(powers[::2]) + 1, max(powers[1::2]) + 1))
    np.add.at(coefficients, (powers[::2], powers[1::2]), numbers)
    return coefficients
