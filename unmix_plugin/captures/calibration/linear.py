"""Stored numbers of any file as numbers that are proportional to light, apart from an offset."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from unmix_plugin.captures.radiometry import radiometric_model
from unmix_plugin.captures.spectral_file import SpectralFile

SRGB = "sRGB"
"""Value of `metadata['encoding']` of pictures for people."""


def is_srgb(file: SpectralFile) -> bool:
    """Whether the file is a picture for people."""
    return file.metadata.get("encoding") == SRGB


def linear(file: SpectralFile, stored: np.ndarray, rows: slice) -> Float32[np.ndarray, "h W b"]:
    """Numbers of some whole rows: pictures decoded, and the calibration applied that the file carries itself.

    Args:
        file: Where they are from.
        stored: As read.
        rows: Which rows of the file they are.
    Raises:
        CaptureError: the calibration in the file is damaged.
    """
    if is_srgb(file):
        return srgb_to_linear(stored)
    model = radiometric_model(file)
    return stored.astype(np.float32) if model is None else model.apply(stored.astype(np.float32), rows)


def srgb_to_linear(stored: np.ndarray) -> Float32[np.ndarray, "*shape"]:
    """Linear light in [0, 1] of integers that are encoded as sRGB (IEC 61966-2-1:1999)."""
    top = np.iinfo(stored.dtype).max
    levels = np.arange(top + 1) / top
    light = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)[stored]
