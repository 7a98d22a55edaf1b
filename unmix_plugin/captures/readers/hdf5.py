"""HDF5, NetCDF-4 and MATLAB 7.3 files, read by h5py in slices.

A file is opened for each part that is read and closed again, so that many can be in use at a time.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.arrays import FoundArray, image_of_arrays
from unmix_plugin.captures.spectral_file import Axes, BandIndex, ReadOptions, SpectralFile, import_extra
from unmix_plugin.errors import CaptureError


def open_hdf5(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the data set that is the image; MATLAB's have their axes in reverse order, which is undone.

    Raises:
        CaptureError: the file is damaged, or no data set, or more than one, can be the image.
    """
    with path.open("rb") as begin:
        is_matlab = begin.read(10) == b"MATLAB 7.3"
    with import_extra("h5py").File(path, "r") as file:
        arrays: list[FoundArray] = []
        file.visititems(lambda name, item: arrays.extend(_found(path, name, item, is_matlab)))
        root = _attributes(file)
    arrays = [_with_attributes(array, root) for array in arrays]
    opened = image_of_arrays(path, "matlab" if is_matlab else "hdf5", arrays, options)
    _refuse_other_files(path, opened.metadata.get("dataset") or arrays[0].name)
    return opened


def _found(path: Path, name: str, item: Any, is_matlab: bool) -> list[FoundArray]:
    if not hasattr(item, "shape") or item.shape is None or "#refs#" in name:
        return []
    shape = tuple(item.shape[::-1] if is_matlab else item.shape)
    if len(shape) != 3 and (item.external or item.is_virtual):
        return []

    def whole() -> np.ndarray:
        return _whole(path, name).T if is_matlab else _whole(path, name)

    def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
        return _take(path, name, axes[::-1] if is_matlab else axes, rows, bands)

    is_cube = len(shape) == 3
    return [
        FoundArray(
            name, shape, item.dtype, whole, take if is_cube else None, _attributes(item), _dimensions(item)
        )
    ]


def _with_attributes(array: FoundArray, root: dict[str, Any]) -> FoundArray:
    """Attributes of the file hold for its images where these have none of that name."""
    return replace(array, attributes={**root, **array.attributes}) if len(array.shape) == 3 else array


def _attributes(item: Any) -> dict[str, Any]:
    """Attributes that h5py can read; files of other programs hold types that it has no word for."""
    attributes = {}
    for name in item.attrs:
        with suppress(OSError, TypeError, ValueError, RuntimeError):
            attributes[name] = item.attrs[name]
    return attributes


def _dimensions(item: Any) -> tuple[str, ...] | None:
    """Names of the axes, by NetCDF's dimension scales or by labels."""
    names = []
    for dimension in item.dims:
        scales = [scale.name for scale in dimension.values()] if len(dimension) else []
        names.append((scales[0] or "") if scales else dimension.label)
    return tuple(names) if any(names) else None


def _refuse_other_files(path: Path, name: str) -> None:
    """Numbers must lie in the file itself, not in one that it points to."""
    with import_extra("h5py").File(path, "r") as file:
        if file[name].external or file[name].is_virtual:
            raise CaptureError(f"{path}: the numbers of {name} lie in other files; write them into this one")


def _whole(path: Path, name: str) -> np.ndarray:
    with import_extra("h5py").File(path, "r") as file:
        return file[name][()]


def _take(path: Path, name: str, axes: str, rows: slice, bands: BandIndex) -> np.ndarray:
    if isinstance(bands, slice):
        wanted, order = bands, slice(None)
    else:
        wanted, order = np.unique(bands, return_inverse=True)  # h5py wants each index once, in rising order
    selection = {"y": rows, "x": slice(None), "b": wanted}
    with import_extra("h5py").File(path, "r") as file:
        part = file[name][tuple(selection[axis] for axis in axes)]
    return part.transpose([axes.index(axis) for axis in "yxb"])[..., order]
