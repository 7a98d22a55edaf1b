"""NumPy's own files: .npy is mapped; of .npz the member that is an image is loaded. No pickle is ever read."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from unmix_plugin.captures.readers.found_arrays import FoundArray
from unmix_plugin.captures.readers.image_of_arrays import image_of_arrays
from unmix_plugin.captures.readers.loaded_arrays import loaded
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.cubes import (
    READ_HEADER,
    UnreadableArrayError,
    map_array,
    parse_header,
    read_array_header,
)


def open_npy(path: Path, options: ReadOptions) -> SpectralFile:
    """Open an array of three axes, or of two for one band, by its header.

    Raises:
        CaptureError: it is cut short, holds objects or no numbers, or has another number of axes.
    """
    try:
        header = read_array_header(path)
    except UnreadableArrayError as error:
        raise CaptureError(f"{path}: {error}") from error
    image = FoundArray("", header.shape, header.dtype, lambda: map_array(path))
    return image_of_arrays(path, "npy", [image], options)


def open_npz(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the image among the arrays of an archive; a list of wavelengths beside it is found by its name.

    Raises:
        CaptureError: a member is damaged or holds objects, or none can be the image.
    """
    with zipfile.ZipFile(path) as archive:
        arrays = [_member(path, archive, info) for info in archive.infolist()]
    return image_of_arrays(path, "npy", arrays, options)


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> FoundArray:
    """A member by its header."""
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version not in READ_HEADER:
            raise CaptureError(
                f"{path}: {info.filename} is a .npy file of version {version}; write it with numpy.savez"
            )
        shape, _, dtype = parse_header(file, version)
    needed = int(np.prod(shape, dtype=object)) * dtype.itemsize
    if not dtype.hasobject and info.file_size < needed:
        raise CaptureError(
            f"{path}: {info.filename} holds {info.file_size} bytes; its header promises {needed}"
        )
    name = info.filename.removesuffix(".npy")
    return FoundArray(name, shape, dtype, lambda: loaded(_load_member, path, info.filename))


def _load_member(path: Path, name: str) -> np.ndarray:
    with zipfile.ZipFile(path) as archive, archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
