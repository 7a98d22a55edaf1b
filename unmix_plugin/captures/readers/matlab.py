"""MATLAB files up to version 7, read by SciPy; those of version 7.3 are HDF5.

Variables are listed without being read; the image is loaded when its first numbers are asked for.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unmix_plugin.captures.readers.found_arrays import FoundArray
from unmix_plugin.captures.readers.image_of_arrays import image_of_arrays
from unmix_plugin.captures.readers.loaded_arrays import loaded
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import SpectralFile

_TYPES = {"double": "f8", "single": "f4", "logical": "u1"}
_NUMBERS = {f"{sign}int{bits}": f"{sign or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)}


def open_matlab(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    from scipy.io import whosmat

    arrays = [_found(path, name, shape, kind) for name, shape, kind in whosmat(str(path))]
    return image_of_arrays(path, "matlab", arrays, options)


def _found(path: Path, name: str, shape: tuple[int, ...], kind: str) -> FoundArray:
    """A variable; what is no array of numbers gets a type that is never taken for one."""
    dtype = np.dtype(_TYPES.get(kind) or _NUMBERS.get(kind, "O"))
    return FoundArray(name, tuple(shape), dtype, lambda: loaded(_load, path, name))


def _load(path: Path, name: str) -> np.ndarray:
    from scipy.io import loadmat

    return np.asarray(loadmat(str(path), variable_names=[name])[name])
