"""HDF5, NetCDF-4 and MATLAB 7.3 files, read by h5py in slices.

A file is opened for each part that is read and closed again, so that many can be in use at a time.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.arrays import FoundArray, image_of_arrays
from unmix_plugin.captures.spectral_file import Axes, BandIndex, ReadOptions, SpectralFile, import_extra
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_decoded, allow_depth, allow_parts


def open_hdf5(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the data set that is the image; MATLAB's have their axes in reverse order, which is undone. Raises
    CaptureError: the file is damaged, or no data set, or more than one, can be the image."""
    h5py = import_extra("h5py")
    with path.open("rb") as begin:
        is_matlab = begin.read(10) == b"MATLAB 7.3"
    arrays: list[FoundArray] = []
    groups: dict[str, dict[str, Any]] = {}

    with h5py.File(path, "r") as file:
        visited = 0

        def visit(name: str, item: Any) -> None:
            nonlocal visited
            visited += 1
            allow_parts(path, visited, "groups and data sets", CaptureError)
            allow_depth(path, name.count("/") + 1, CaptureError)
            arrays.extend(_found(path, name, item, is_matlab))
            if not hasattr(item, "shape"):
                groups[name] = _attributes(path, item)

        file.visititems(visit)
        root = _attributes(path, file)
    # Attributes of the file and of groups hold for images in them.
    arrays = [
        replace(array, inherited=_inherited(array.name, root, groups)) if len(array.shape) == 3 else array
        for array in arrays
    ]
    opened = image_of_arrays(path, "matlab" if is_matlab else "hdf5", arrays, options)
    name = opened.metadata.get("dataset") or arrays[0].name
    with h5py.File(path, "r") as file:
        image = file[name]
        if image.external or image.is_virtual:
            raise CaptureError(f"{path}: the numbers of {name} lie in other files; write them into this one")
        of_chunk = prod(image.chunks) if image.chunks else 0
        allow_decoded(path, max(image.size, of_chunk) * image.dtype.itemsize, CaptureError)
    return opened


def _inherited(name: str, root: dict[str, Any], groups: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Attributes of the file and of the groups that an array is in; the nearest go before the others."""
    parts = name.split("/")[:-1]
    inherited = dict(root)
    for depth in range(1, len(parts) + 1):
        inherited |= groups.get("/".join(parts[:depth]), {})
    return inherited


def _found(path: Path, name: str, item: Any, is_matlab: bool) -> list[FoundArray]:
    if not hasattr(item, "shape") or item.shape is None or "#refs#" in name:
        return []
    shape = tuple(item.shape[::-1] if is_matlab else item.shape)
    is_cube = len(shape) == 3
    if not is_cube and (item.external or item.is_virtual):
        return []

    def whole() -> np.ndarray:
        with import_extra("h5py").File(path, "r") as file:
            stored = file[name][()]
        return stored.T if is_matlab else stored

    def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
        stored_axes = axes[::-1] if is_matlab else axes
        wanted, order = bands, slice(None)
        if not isinstance(bands, slice):  # h5py wants each index once, in rising order
            wanted, order = np.unique(bands, return_inverse=True)
        selection = {"y": rows, "x": slice(None), "b": wanted}
        with import_extra("h5py").File(path, "r") as file:
            part = file[name][tuple(selection[axis] for axis in stored_axes)]
        return part.transpose([stored_axes.index(axis) for axis in "yxb"])[..., order]

    names = []  # of the axes, by NetCDF's dimension scales or by labels
    for dimension in item.dims:
        scales = [scale.name for scale in dimension.values()] if len(dimension) else []
        names.append((scales[0] or "") if scales else dimension.label)
    dimensions, faster = tuple(names) if any(names) else None, take if is_cube else None
    attributes = _attributes(path, item)
    return [FoundArray(name, shape, item.dtype, whole, faster, attributes, dimensions=dimensions)]


def _attributes(path: Path, item: Any) -> dict[str, Any]:
    """Attributes that h5py can read; files of other programs hold types that it has no word for."""
    attributes = {}
    allow_parts(path, len(item.attrs), "attributes", CaptureError)
    for name in item.attrs:
        with suppress(OSError, TypeError, ValueError, RuntimeError):
            attributes[name] = item.attrs[name]
    return attributes
