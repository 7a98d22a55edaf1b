"""MATLAB files of version 5 to 7; those of version 7.3 are HDF5.

Numbers that lie open are mapped. Compressed ones are unpacked when the first of them are asked for.
"""

from __future__ import annotations

import zlib
from math import prod
from pathlib import Path

import numpy as np

from unmix_plugin.captures.readers.array_axes import take_part
from unmix_plugin.captures.readers.found_arrays import FoundArray
from unmix_plugin.captures.readers.image_of_arrays import image_of_arrays
from unmix_plugin.captures.readers.loaded_arrays import loaded
from unmix_plugin.captures.readers.matlab_elements import MatlabArray, list_arrays
from unmix_plugin.captures.readers.read_options import Axes, ReadOptions
from unmix_plugin.captures.spectral_file import BandIndex, SpectralFile
from unmix_plugin.errors import CaptureError


def open_matlab(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    try:
        arrays = list_arrays(path)
    except (ValueError, zlib.error) as error:
        raise CaptureError(f"{path}: a damaged MATLAB file: {error}; copy it again") from error
    return image_of_arrays(path, "matlab", [_found(path, array) for array in arrays], options)


def _found(path: Path, array: MatlabArray) -> FoundArray:
    def stored() -> np.ndarray:
        if array.packed is not None:
            return loaded(_unpack, path, array)
        return np.memmap(path, array.stored, "r", array.offset, array.shape, order="F")

    def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
        return take_part(stored(), axes, rows, bands).astype(array.dtype)

    return FoundArray(array.name, array.shape, array.dtype, lambda: stored().astype(array.dtype), take)


def _unpack(path: Path, array: MatlabArray) -> np.ndarray:
    """The numbers of a compressed variable; no more is unpacked than the variable needs."""
    start, length = array.packed or (0, 0)
    with path.open("rb") as file:
        file.seek(start)
        packed = file.read(length)
    needed = prod(array.shape) * array.stored.itemsize
    unpacked = zlib.decompressobj().decompress(packed, array.offset + needed)
    if len(unpacked) < array.offset + needed:
        raise CaptureError(f"{path}: variable '{array.name}' is cut short; copy the file again")
    return np.frombuffer(unpacked, array.stored, offset=array.offset, count=prod(array.shape)).reshape(
        array.shape, order="F"
    )
