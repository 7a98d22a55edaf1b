"""Spectral files whose numbers are given, for tests that need no disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.spectral_file import BandTable, SpectralFile


def file_of(values: np.ndarray, wavelengths_nm: np.ndarray | None = None, **facts: Any) -> SpectralFile:
    """A file with these numbers (H, W, B); more facts by the names of `SpectralFile`'s fields."""
    table = BandTable(wavelengths_nm)
    height, width, bands = values.shape
    return SpectralFile(
        Path("memory.npy"),
        "npy",
        (height, width, bands),
        values.dtype,
        lambda rows, wanted: values[rows][..., wanted],
        table,
        **facts,
    )
