"""DJI P4 Multispectral and Mavic 3 Multispectral: radiance in a unit of its own, the same for all bands.

    L = V(r) * (p - black level) / 2^bits / (gain * exposure) * gain adjustment

with V a polynomial of the distance to the calibrated optical centre, which multiplies here; exposure in seconds.
Source: DJI, P4 Multispectral and Mavic 3M image processing guides.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import XmpTags, tag_numbers
from unmix_plugin.captures.radiometry.model import (
    RadiometricModel,
    radial_polynomial,
    require_numbers,
    stored_range,
)
from unmix_plugin.captures.spectral_file import SpectralFile

SATURATED = 65520.0


def is_maker(tags: XmpTags) -> bool:
    """Whether a file carries this calibration."""
    return tag_numbers(tags, "drone-dji:SensorGain") is not None


def read_model(file: SpectralFile, tags: XmpTags, exif: dict[str, Any]) -> RadiometricModel:
    """The calibration of a file.

    Raises:
        CaptureError: a tag is absent or of the wrong size.
    """

    def read(count: int, *names: str, positive: bool = False) -> list[float]:
        return require_numbers(file, f"XMP {names[0]}", tag_numbers(tags, *names), count, positive=positive)

    (gain,) = read(1, "drone-dji:SensorGain", positive=True)
    (microseconds,) = read(1, "drone-dji:ExposureTime", positive=True)
    adjustment = tag_numbers(tags, "drone-dji:SensorGainAdjustment") or [1.0]
    levels = exif.get("BlackLevel") or read(1, "drone-dji:BlackLevel", "BlackLevel", "BlackCurrent")
    polynomial = tag_numbers(tags, "VignettingData", "VignettingPolynomial") or []
    centre = [0.0, 0.0]
    if polynomial:
        middle = tag_numbers(tags, "VignettingCenter") or [
            number
            for axis in "XY"
            for number in tag_numbers(tags, f"drone-dji:CalibratedOpticalCenter{axis}") or []
        ]
        centre = require_numbers(file, "XMP drone-dji:CalibratedOpticalCenterX, Y", middle or None, 2)
    scale = adjustment[0] / (gain * 1e-6 * microseconds) / stored_range(exif)

    def factor_of(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        return scale * radial_polynomial(polynomial, centre, y, x)

    irradiance = tag_numbers(tags, "drone-dji:Irradiance")
    return RadiometricModel(
        "DJI", "relative", float(np.mean(levels)), SATURATED, factor_of, irradiance[0] if irradiance else None
    )
