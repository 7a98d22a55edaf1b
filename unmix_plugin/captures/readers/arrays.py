"""Files that hold arrays by name: which is the image, which describe its bands, and how NumPy, torch, NetCDF, MATLAB
and HDF5 store them.

Notation: `H` rows, `W` columns, `B` bands.
"""

from __future__ import annotations

import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from unmix_plugin.captures.spectral_file import (
    Axes,
    BandIndex,
    ReadOptions,
    SpectralFile,
    choose_axes,
    image_shape,
    import_extra,
    loaded,
    take_part,
)
from unmix_plugin.captures.wavelengths import StatedBands, check_bands
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.cubes import (
    READ_HEADER,
    UnreadableArrayError,
    map_array,
    parse_header,
    read_array_header,
)

_TakePart: TypeAlias = Callable[[Axes, slice, BandIndex], np.ndarray]
"""(h, W, b) numbers of a stored array whose axes are these."""

_CENTRES = re.compile(
    r"(list_cw_.*)|((band_?|cent(er|re|ral)_?|sensor_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?))(_?(nm|um))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_.*)(_?(nm|um))?")
_GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)")
_NO_DATA = ("_fillvalue", "missing_value", "data_ignore_value", "nodata", "no_data")
_SCALES = ("scale_factor", "reflectance_scale_factor")
_AXIS_NAMES = {
    "b": "band bands wavelength wavelengths wl lambda channel spectral",
    "y": "y lat latitude row rows line lines downtrack northing height",
    "x": "x lon longitude col cols column columns sample samples crosstrack easting width",
}
_AXES = {name: axis for axis, names in _AXIS_NAMES.items() for name in names.split()}
_LISTED = 12
"""How many arrays a message names."""


@dataclass(frozen=True)
class _FoundArray:
    """One array of a file."""

    name: str
    """With the groups that it is in, separated by `/`."""
    shape: tuple[int, ...]
    dtype: np.dtype
    whole: Callable[[], np.ndarray]
    """All its numbers, mapped or loaded."""
    take: _TakePart | None = None
    """A faster way to some rows and bands than through `whole`."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    dimensions: tuple[str, ...] | None = None
    """Names of its axes."""

    @property
    def own_name(self) -> str:
        """Without groups, in lower case."""
        return self.name.rpartition("/")[2].lower()

    @property
    def is_vector(self) -> bool:
        """Whether it is a list of numbers, also as MATLAB's matrix of one row or column."""
        is_list = bool(self.shape) and sum(length != 1 for length in self.shape) <= 1
        return is_list and self.dtype.kind in "iuf"


def _image_of_arrays(
    path: Path, reader: str, arrays: Sequence[_FoundArray], options: ReadOptions
) -> SpectralFile:
    """The image of a file: the array that is named, otherwise the only one of three axes."""
    image = _find_image(path, arrays, options)
    what = image.name or "the array"
    size = _pixel_list_size(image, arrays, options)
    fixed, notes = options.axes, ()
    shape, take = image.shape, image.take
    if len(image.shape) == 2:  # a list of pixels, column after column, or one band
        if size is None and options.size is not None:
            raise CaptureError(f"{path}: {what} {shape} is not a list of {prod(options.size)} pixels")
        if size is None:
            shape, fixed = (*image.shape, 1), "yxb"
        elif image.shape[1] == prod(size):
            shape, fixed = (image.shape[0], size[1], size[0]), "bxy"
        else:
            shape, fixed = (size[1], size[0], image.shape[1]), "xyb"
        take = None
    elif len(image.shape) != 3:
        raise CaptureError(f"{path}: {what} has the shape {image.shape}; expected three axes")
    elif fixed is None:
        names = (name.lower().rpartition("/")[2] for name in image.dimensions or ())
        named: Any = "".join(_AXES.get(name, "?") for name in names)
        fixed = named if sorted(named) == ["b", "x", "y"] else None
    stated = _state_bands(arrays, image)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    axes, notes = choose_axes(shape, fixed, None if given is None else len(given))
    of_image = image_shape(shape, axes)
    bands, band_notes = check_bands(stated, of_image[2])
    scale, scale_notes = _scale(image.attributes)

    def read_part(rows: slice, wanted: BandIndex) -> np.ndarray:
        if take is not None:
            return take(axes, rows, wanted)
        return take_part(image.whole().reshape(shape), axes, rows, wanted)

    return SpectralFile(
        path=path,
        reader=reader,
        shape=of_image,
        dtype=image.dtype,
        read_part=read_part,
        bands=bands,
        scale=scale,
        no_data=_first_number(image.attributes, _NO_DATA),
        notes=notes + band_notes + scale_notes,
        metadata={"dataset": image.name, "axes": axes} if len(arrays) > 1 else {"axes": axes},
    )


def _find_image(path: Path, arrays: Sequence[_FoundArray], options: ReadOptions) -> _FoundArray:
    numeric = [array for array in arrays if array.dtype.kind in "iuf" and 0 not in array.shape]
    if [(array.name, len(array.shape)) for array in arrays] == [("", 2)] and options.dataset is None:
        return arrays[0]  # the file is one matrix: one band
    listed = ", ".join(f"{array.name or 'one array'} {array.shape}" for array in numeric[:_LISTED])
    listed = listed or "no arrays of numbers"
    if options.dataset is not None:
        wanted = options.dataset.strip("/")
        named = [array for array in numeric if array.name.strip("/") == wanted]
        named = named or [array for array in numeric if array.name.rpartition("/")[2] == wanted]
        if len(named) != 1:
            raise CaptureError(
                f"{path}: {len(named) or 'no'} data sets '{options.dataset}'; the file holds {listed}"
            )
        return named[0]
    images = [array for array in numeric if len(array.shape) == 3]
    if not images:
        images = [array for array in numeric if _pixel_list_size(array, arrays, options) is not None]
    if len(images) > 1:
        images = [image for image in images if _find_vector(arrays, image, _CENTRES) is not None] or images
    if not images:
        raise CaptureError(
            f"{path}: no data set has three axes; name one (--dataset), and give rows and columns if it is a list of "
            f"pixels. The file holds {listed}"
        )
    if len(images) > 1:
        raise CaptureError(
            f"{path}: {len(images)} data sets could be the image; name one (--dataset). The file holds {listed}"
        )
    return images[0]


def _pixel_list_size(
    array: _FoundArray, arrays: Sequence[_FoundArray], options: ReadOptions
) -> tuple[int, int] | None:
    """Rows and columns of an image that is stored as a matrix of bands and pixels; None if it is not such a matrix.

    Files of unmixing scenes give them as numbers `nRow` and `nCol`.
    """
    size = options.size
    numbers = {one.own_name.rstrip("s"): one for one in arrays if one.is_vector and prod(one.shape) == 1}
    if size is None and "nrow" in numbers and "ncol" in numbers:
        rows, columns = (float(numbers[name].whole().reshape(-1)[0]) for name in ("nrow", "ncol"))
        size = (int(rows), int(columns)) if 1 <= rows < 2**31 and 1 <= columns < 2**31 else None
    if len(array.shape) != 2 or size is None or prod(size) not in array.shape:
        return None
    return size


def _find_vector(
    arrays: Sequence[_FoundArray], image: _FoundArray, names: re.Pattern[str]
) -> _FoundArray | None:
    """The list of one number a band with such a name; of several the one in the nearest group."""

    def common_groups(name: str) -> int:
        pairs = zip(name.strip("/").split("/")[:-1], image.name.strip("/").split("/")[:-1], strict=False)
        least = min(name.count("/"), image.name.count("/"))
        return next((count for count, (a, b) in enumerate(pairs) if a != b), least)

    found = [
        array
        for array in arrays
        if array.is_vector and prod(array.shape) in image.shape and names.fullmatch(array.own_name)
    ]
    return max(found, key=lambda array: common_groups(array.name), default=None)


def _state_bands(arrays: Sequence[_FoundArray], image: _FoundArray) -> StatedBands:
    """What arrays or attributes say of the bands."""

    def numbers(vector: _FoundArray | None) -> list[object] | None:
        return None if vector is None else vector.whole().reshape(-1).tolist()

    centres, widths, good = (_find_vector(arrays, image, names) for names in (_CENTRES, _WIDTHS, _GOOD))
    if centres is not None:
        where, listed = f"data set '{centres.name}'", numbers(centres)
        name, attributes = centres.own_name, centres.attributes
    else:
        attribute = next((key for key in image.attributes if _CENTRES.fullmatch(key.lower())), None)
        values = np.atleast_1d(image.attributes[attribute]) if attribute is not None else np.zeros(0)
        listed = values.tolist() if values.ndim == 1 and len(values) in image.shape else None
        where, name, attributes = f"attribute '{attribute}'", attribute or "", {}
    unit = next((value for key, value in attributes.items() if key.lower() in ("unit", "units")), None)
    if unit is None:
        suffix = name.lower()[-2:]
        unit = suffix if suffix in ("nm", "um") else None
    else:
        unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
    return StatedBands(where, listed, unit, numbers(widths), numbers(good))


def _scale(attributes: Mapping[str, Any]) -> tuple[float | None, tuple[str, ...]]:
    """Stored number that stands for 1: factors above 1 divide, those below multiply, as climate files have it."""
    factor = _first_number(attributes, _SCALES)
    offset = _first_number(attributes, ("add_offset",))
    note = f"an offset of {offset:g} is to be added to scaled values, which is left to you" if offset else ""
    notes = (note,) if note else ()
    if factor is None or not np.isfinite(factor) or factor <= 0 or factor == 1:
        return None, notes
    return (factor if factor > 1 else 1 / factor), notes


def _first_number(attributes: Mapping[str, Any], names: Sequence[str]) -> float | None:
    for key, value in attributes.items():
        if key.lower() in names:
            try:
                return float(np.asarray(value).reshape(-1)[0])
            except (ValueError, TypeError, IndexError):
                continue
    return None


# NumPy: .npy is mapped, of .npz the member that is an image is loaded. No pickle is ever read.


def open_npy(path: Path, options: ReadOptions) -> SpectralFile:
    """Open an array of three axes, or of two for one band, by its header.

    Raises:
        CaptureError: it is cut short, holds objects or no numbers, or has another number of axes.
    """
    try:
        header = read_array_header(path)
    except UnreadableArrayError as error:
        raise CaptureError(f"{path}: {error}") from error
    image = _FoundArray("", header.shape, header.dtype, lambda: map_array(path))
    return _image_of_arrays(path, "npy", [image], options)


def open_npz(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the image among the arrays of an archive; a list of wavelengths beside it is found by its name.

    Raises:
        CaptureError: a member is damaged or holds objects, or none can be the image.
    """
    with zipfile.ZipFile(path) as archive:
        arrays = [_npz_member(path, archive, info) for info in archive.infolist()]
    return _image_of_arrays(path, "npy", arrays, options)


def _npz_member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> _FoundArray:
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
    return _FoundArray(name, shape, dtype, lambda: loaded(_load_npz_member, path, info.filename))


def _load_npz_member(path: Path, name: str) -> np.ndarray:
    with zipfile.ZipFile(path) as archive, archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


# Tensors that torch.save wrote: read with weights_only, which loads no code.


def open_torch(path: Path, options: ReadOptions) -> SpectralFile:
    """Open a tensor, or the image among the tensors of a dictionary.

    Raises:
        CaptureError: the file is damaged, holds other objects than tensors, or none can be the image.
    """
    import torch

    def tensors() -> dict[str, Any]:
        """By name, mapped where the file allows it."""
        with path.open("rb") as file:
            is_mappable = file.read(2) == b"PK"
        try:
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=is_mappable)
        except pickle.UnpicklingError as error:
            raise CaptureError(
                f"{path}: holds other objects than tensors, which are never loaded because they can run code; "
                "save a plain tensor with torch.save"
            ) from error
        named = content if isinstance(content, dict) else {"": content}
        return {str(name): value for name, value in named.items() if isinstance(value, torch.Tensor)}

    def numbers(tensor: torch.Tensor) -> np.ndarray:
        """What NumPy has no type for becomes float32."""
        tensor = tensor.detach()
        return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor.resolve_neg()).numpy()

    arrays = [
        _FoundArray(
            name,
            tuple(tensor.shape),
            numbers(tensor[:0] if tensor.ndim else tensor).dtype,
            lambda name=name: numbers(tensors()[name]),
        )
        for name, tensor in tensors().items()
    ]
    return _image_of_arrays(path, "torch", arrays, options)


# NetCDF of the classic kind, mapped by SciPy.


def open_netcdf3(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    from scipy.io import netcdf_file

    def found(name: str, variable: Any) -> _FoundArray:
        """A variable, without holding on to the map of its file."""

        def whole() -> np.ndarray:
            with netcdf_file(str(path), "r", mmap=True) as file:
                return np.array(file.variables[name].data)

        def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
            with netcdf_file(str(path), "r", mmap=True) as file:
                return take_part(file.variables[name].data, axes, rows, bands)

        attributes = dict(variable._attributes)
        kind = variable.data.dtype
        return _FoundArray(name, variable.shape, kind, whole, take, attributes, variable.dimensions)

    with netcdf_file(str(path), "r", mmap=True) as file:
        arrays = [found(name, variable) for name, variable in file.variables.items()]
    return _image_of_arrays(path, "netcdf", arrays, options)


# MATLAB's version 5 to 7; files of version 7.3 are HDF5. Numbers that lie open are mapped, compressed ones are unpacked
# when the first of them are asked for. Read here rather than by SciPy, which ends the process on some damaged files
# and can't map numbers. Source: The MathWorks, MAT-File Format, chapter 1 (level 5).

_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_IS_COMPLEX = 0x0800
_HEAD_BYTES = 2**16
"""Enough for what precedes the numbers of an array."""
_PIECE_BYTES = 2**20


@dataclass(frozen=True)
class _MatlabArray:
    """One array of numbers; axes in MATLAB's order, the first axis fastest."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    """In MATLAB; files may hold a smaller type."""
    stored: np.dtype
    offset: int
    """Of the first number, from the start of the file or of the unpacked element."""
    packed: tuple[int, int] | None
    """Where the compressed element lies and how long it is; None where numbers lie open."""


def open_matlab(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image; cells, structures, texts and complex numbers are passed over.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """

    def found(array: _MatlabArray) -> _FoundArray:
        def stored() -> np.ndarray:
            if array.packed is not None:
                return loaded(_unpack, path, array)
            return np.memmap(path, array.stored, "r", array.offset, array.shape, order="F")

        def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
            return take_part(stored(), axes, rows, bands).astype(array.dtype)

        return _FoundArray(array.name, array.shape, array.dtype, lambda: stored().astype(array.dtype), take)

    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:128])
            if order is None:
                raise ValueError("the header is damaged")
            arrays = [_matlab_array(file, order, *element) for element in _elements(file, order, size)]
    except (ValueError, zlib.error) as error:
        raise CaptureError(f"{path}: a damaged MATLAB file: {error}; copy it again") from error
    return _image_of_arrays(path, "matlab", [found(array) for array in arrays if array is not None], options)


def _elements(file: BinaryIO, order: str, size: int) -> Iterator[tuple[int, int, int]]:
    """Start of the content, type and length of each element at the top."""
    position = 128
    while position + 8 <= size:
        file.seek(position)
        kind, length = struct.unpack(order + "II", file.read(8))
        start = position + 8
        if start + length > size:
            raise ValueError(f"cut short: an element reaches to byte {start + length} of {size}")
        yield start, kind, length
        position = start + length + (-length % 8 if kind != _COMPRESSED else 0)
    if position < size and size - position != -position % 8:
        raise ValueError("cut short within the head of an element")


def _matlab_array(file: BinaryIO, order: str, start: int, kind: int, length: int) -> _MatlabArray | None:
    """An array of real numbers by the first bytes of its element; None for anything else."""
    file.seek(start)
    head, packed = file.read(min(length, _HEAD_BYTES)), None
    if kind == _COMPRESSED:
        head, packed = zlib.decompressobj().decompress(head, _HEAD_BYTES), (start, length)
        kind, length = _tag(head, order, 0)[:2]
        head, start = head[8:], 8
    if kind != _MATRIX:
        return None
    _, _, at, end = _tag(head, order, 0)
    (flags,) = struct.unpack_from(order + "I", head, at)
    if flags & 0xFF not in _CLASSES or flags & _IS_COMPLEX:
        return None
    _, count, at, end = _tag(head, order, end)
    shape = struct.unpack_from(f"{order}{count // 4}i", head, at)
    _, count, at, end = _tag(head, order, end)
    name = head[at : at + count].decode("utf-8", "replace")
    kind, count, at, _ = _tag(head, order, end)
    if kind not in _STORED or min(shape, default=-1) < 0:
        raise ValueError(f"variable '{name}' has the type {kind} and the shape {shape}")
    stored = np.dtype(order + _STORED[kind])
    if prod(shape) * stored.itemsize != count or at + count > length:
        raise ValueError(f"variable '{name}' of {shape} {stored.name} has {count} bytes")
    return _MatlabArray(name, shape, np.dtype(_CLASSES[flags & 0xFF]), stored, start + at, packed)


def _tag(head: bytes, order: str, position: int) -> tuple[int, int, int, int]:
    """Type and length of an element; where its content begins, and where the next element does."""
    if position + 8 > len(head):
        raise ValueError("cut short within a variable")
    kind, length = struct.unpack_from(order + "II", head, position)
    if kind >> 16:  # a small element has its content in its head
        return kind & 0xFFFF, kind >> 16, position + 4, position + 8
    return kind, length, position + 8, position + 8 + length + (-length % 8)


def _unpack(path: Path, array: _MatlabArray) -> np.ndarray:
    """The numbers of a compressed variable, unpacked piece by piece to where they stay, and no more than it needs."""
    start, left = array.packed or (0, 0)
    numbers = np.zeros(prod(array.shape), array.stored)
    target, at, unpacking = numbers.view(np.uint8), -array.offset, zlib.decompressobj()
    with path.open("rb") as file:
        file.seek(start)
        while at < len(target):
            packed = unpacking.unconsumed_tail
            if not packed:
                packed = file.read(min(_PIECE_BYTES, left))
                left -= len(packed)
            piece = unpacking.decompress(packed, _PIECE_BYTES)
            if not packed and not piece:
                raise CaptureError(f"{path}: variable '{array.name}' is cut short; copy the file again")
            part = piece[max(0, -at) : len(target) - at]
            target[max(0, at) : max(0, at) + len(part)] = np.frombuffer(part, np.uint8)
            at += len(piece)
    return numbers.reshape(array.shape, order="F")


# HDF5, NetCDF-4 and MATLAB 7.3, read by h5py in slices. A file is opened for each part that is read and closed again,
# so that many can be in use at a time.


def open_hdf5(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the data set that is the image; MATLAB's have their axes in reverse order, which is undone.

    Raises:
        CaptureError: the file is damaged, or no data set, or more than one, can be the image.
    """
    h5py = import_extra("h5py")
    with path.open("rb") as begin:
        is_matlab = begin.read(10) == b"MATLAB 7.3"
    arrays: list[_FoundArray] = []
    with h5py.File(path, "r") as file:
        file.visititems(lambda name, item: arrays.extend(_found(path, name, item, is_matlab)))
        root = _attributes(file)
    # Attributes of the file hold for its images where these have none of that name.
    arrays = [
        replace(array, attributes={**root, **array.attributes}) if len(array.shape) == 3 else array
        for array in arrays
    ]
    opened = _image_of_arrays(path, "matlab" if is_matlab else "hdf5", arrays, options)
    name = opened.metadata.get("dataset") or arrays[0].name
    with h5py.File(path, "r") as file:
        if file[name].external or file[name].is_virtual:
            raise CaptureError(f"{path}: the numbers of {name} lie in other files; write them into this one")
    return opened


def _found(path: Path, name: str, item: Any, is_matlab: bool) -> list[_FoundArray]:
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

    # Names of the axes, by NetCDF's dimension scales or by labels.
    names = []
    for dimension in item.dims:
        scales = [scale.name for scale in dimension.values()] if len(dimension) else []
        names.append((scales[0] or "") if scales else dimension.label)
    dimensions = tuple(names) if any(names) else None
    return [
        _FoundArray(name, shape, item.dtype, whole, take if is_cube else None, _attributes(item), dimensions)
    ]


def _attributes(item: Any) -> dict[str, Any]:
    """Attributes that h5py can read; files of other programs hold types that it has no word for."""
    attributes = {}
    for name in item.attrs:
        with suppress(OSError, TypeError, ValueError, RuntimeError):
            attributes[name] = item.attrs[name]
    return attributes
