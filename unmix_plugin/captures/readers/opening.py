"""Any file of an instrument as a `SpectralFile`: the reader is chosen by what the file holds.

Nothing but headers is read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from unmix_plugin.captures.readers.band_folder import open_band_folder
from unmix_plugin.captures.readers.envi import open_envi
from unmix_plugin.captures.readers.exr import open_exr
from unmix_plugin.captures.readers.file_kinds import file_kind
from unmix_plugin.captures.readers.hdf5 import open_hdf5
from unmix_plugin.captures.readers.matlab import open_matlab
from unmix_plugin.captures.readers.netcdf3 import open_netcdf3
from unmix_plugin.captures.readers.numpy_files import open_npy, open_npz
from unmix_plugin.captures.readers.pictures import open_picture
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.readers.tiff import open_tiff
from unmix_plugin.captures.readers.torch_files import open_torch
from unmix_plugin.captures.spectral_file import SpectralFile, unreadable
from unmix_plugin.errors import CaptureError

Reader: TypeAlias = Callable[[Path, ReadOptions], SpectralFile]

_READERS: dict[str, Reader] = {
    "envi": open_envi,
    "tiff": open_tiff,
    "exr": open_exr,
    "npy": open_npy,
    "npz": open_npz,
    "matlab": open_matlab,
    "hdf5": open_hdf5,
    "netcdf": open_netcdf3,
    "picture": open_picture,
    "torch": open_torch,
    "folder": lambda path, options: open_band_folder(
        path, lambda band: _READERS[file_kind(band)](band, options)
    ),
}


def open_spectral_file(path: Path, options: ReadOptions | None = None) -> SpectralFile:
    """Open a file, or a folder that holds one picture a band, without reading its numbers.

    Args:
        path: For ENVI the header or the file of numbers.
        options: What the user gives, which overrides the file.
    Raises:
        CaptureError: the file is missing, damaged or of no known kind, or the options don't fit it.
    """
    options = options or ReadOptions()
    try:
        opened = _READERS[file_kind(path)](path, options)
        if 0 in opened.shape:
            raise CaptureError(f"{path}: the image has no pixels: {_size(opened)}")
        return _with_wavelengths(opened, options)
    except CaptureError:
        raise
    except Exception as error:
        raise unreadable(path, error) from error


def _with_wavelengths(opened: SpectralFile, options: ReadOptions) -> SpectralFile:
    given = options.wavelengths_nm
    if given is None:
        return opened
    if len(given) != opened.shape[2]:
        raise CaptureError(
            f"{opened.path}: {len(given)} wavelengths were given for {_size(opened)}; expected one a band"
        )
    return replace(opened, bands=replace(opened.bands, wavelengths_nm=given, evidence="given by the user"))


def _size(opened: SpectralFile) -> str:
    height, width, num_bands = opened.shape
    return f"{height} rows x {width} columns x {num_bands} bands"
