"""Spectral images of random numbers, and a disk that is full after some bytes."""

from __future__ import annotations

import errno
import os

import numpy as np

from unmix_plugin.spectral.bands import Bands

WAVELENGTHS_NM = (400.0, 437.5125, 500.1, 612.0, 1001.25)
BANDS = Bands.of(WAVELENGTHS_NM)


def random_cube(height: int = 7, width: int = 5, bands: int = len(WAVELENGTHS_NM)) -> np.ndarray:
    """(H, W, B) float32 with values below 0 and above 1 too."""
    return np.random.default_rng(0).normal(0.5, 1.0, (height, width, bands)).astype(np.float32)


def full_disk(monkeypatch, after: int) -> None:
    """Let `os.write` write so many bytes and then find no space left."""
    left, write = [after], os.write

    def limited(descriptor, data):
        if len(data) > left[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        left[0] -= len(data)
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", limited)
