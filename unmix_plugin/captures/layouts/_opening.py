"""Opening .npy cubes, ENVI images and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.spectral_file import BandIndex, BandTable, SpectralFile
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.arrays import UnreadableArrayError, map_array, read_array_header


def open_spectral_file(path: Path) -> SpectralFile:
    """One image, opened without being read.

    Raises:
        CaptureError: it can't be read.
    """
    table, kind = BandTable(), path.suffix.lower()
    values: Any
    if kind == ".npy":
        try:
            read_array_header(path)
        except UnreadableArrayError as error:
            raise CaptureError(f"{path} {error}") from error
        values = map_array(path)
    elif kind == ".hdr":
        import spectral.io.envi

        image: Any = spectral.io.envi.open(str(path))
        values = image.open_memmap(interleave="bip")
        if image.bands.centers:
            table = BandTable(np.array(image.bands.centers, dtype=np.float64), "header field 'wavelength'")
    else:
        from PIL import Image

        values = np.asarray(Image.open(path).convert("RGB"))

    def read_part(rows: slice, bands: BandIndex) -> np.ndarray:
        return np.asarray(values[rows][..., bands])

    return SpectralFile(path, kind.strip("."), values.shape, values.dtype, read_part, table)
