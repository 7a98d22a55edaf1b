"""NetCDF files of the classic kind, mapped by SciPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.array_axes import take_part
from unmix_plugin.captures.readers.found_arrays import FoundArray
from unmix_plugin.captures.readers.image_of_arrays import image_of_arrays
from unmix_plugin.captures.readers.read_options import Axes, ReadOptions
from unmix_plugin.captures.spectral_file import BandIndex, SpectralFile


def open_netcdf3(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    with _opened(path) as file:
        arrays = [_found(path, name, variable) for name, variable in file.variables.items()]
    return image_of_arrays(path, "netcdf", arrays, options)


def _found(path: Path, name: str, variable: Any) -> FoundArray:
    """A variable, without holding on to the map of its file."""

    def whole() -> np.ndarray:
        with _opened(path) as file:
            return np.array(file.variables[name].data)

    def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
        with _opened(path) as file:
            return take_part(file.variables[name].data, axes, rows, bands)

    attributes = dict(variable._attributes)
    return FoundArray(name, variable.shape, variable.data.dtype, whole, take, attributes, variable.dimensions)


def _opened(path: Path) -> Any:
    """The file, whose variables nothing may hold when it is closed."""
    from scipy.io import netcdf_file

    return netcdf_file(str(path), "r", mmap=True)
