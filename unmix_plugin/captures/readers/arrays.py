"""Files that hold many arrays by name: which is the image, and which describe its bands.

Notation: `H` rows, `W` columns, `B` bands.

An image out of a file of named arrays: its axes, bands, scale and no-data value.

Notation: `H` rows, `W` columns, `B` bands.

NumPy's own files: .npy is mapped; of .npz the member that is an image is loaded. No pickle is ever read.

Tensors that torch.save wrote: read with weights_only, which loads no code.

NetCDF files of the classic kind, mapped by SciPy.

Elements of a MATLAB file of version 5 to 7: which arrays of numbers it holds, and where.

Read here rather than by SciPy, which ends the process on some damaged files, and which can't map numbers.

Source: The MathWorks, MAT-File Format, chapter 1 (level 5).

MATLAB files of version 5 to 7; those of version 7.3 are HDF5.

Numbers that lie open are mapped. Compressed ones are unpacked when the first of them are asked for.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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

TakePart: TypeAlias = Callable[[Axes, slice, BandIndex], np.ndarray]
"""(h, W, b) numbers of a stored array whose axes are these."""

_CENTRES = re.compile(
    r"(list_cw_.*)|((band_?|cent(er|re|ral)_?|sensor_?)*(wavelengths?|wavelen|wvls?|wls?|lambdas?|waves?))(_?(nm|um))?"
)
_WIDTHS = re.compile(r"(fwhms?|band_?widths?|list_fwhm_.*)(_?(nm|um))?")
_GOOD = re.compile(r"bbl|good_(wavelengths?|bands?)")
_LISTED = 12
"""How many arrays a message names."""


@dataclass(frozen=True)
class FoundArray:
    """One array of a file."""

    name: str
    """With the groups that it is in, separated by `/`."""
    shape: tuple[int, ...]
    dtype: np.dtype
    whole: Callable[[], np.ndarray]
    """All its numbers, mapped or loaded."""
    take: TakePart | None = None
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
        return (
            self.dtype.kind in "iuf" and sum(length != 1 for length in self.shape) <= 1 and bool(self.shape)
        )

    @property
    def length(self) -> int:
        """Of a vector."""
        return int(np.prod(self.shape))


def find_image(path: Path, arrays: Sequence[FoundArray], options: ReadOptions) -> FoundArray:
    """The array that is the image: the one that is named, otherwise the only one of three axes.

    Raises:
        CaptureError: there is none, or several that could be it.
    """
    numeric = [array for array in arrays if array.dtype.kind in "iuf" and 0 not in array.shape]
    if [(array.name, len(array.shape)) for array in arrays] == [("", 2)] and options.dataset is None:
        return arrays[0]  # the file is one matrix: one band
    listed = (
        ", ".join(f"{array.name or 'one array'} {array.shape}" for array in numeric[:_LISTED])
        or "no arrays of numbers"
    )
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
        images = [array for array in numeric if pixel_list_size(array, arrays, options) is not None]
    if len(images) > 1:
        fitting = [image for image in images if find_vector(arrays, image, _CENTRES) is not None]
        images = fitting or images
    if len(images) != 1:
        found = f"{len(images)} data sets could be the image" if images else "no data set has three axes"
        advice = (
            "name one (--dataset)"
            if images
            else "name one (--dataset), and give rows and columns if it is a list of pixels"
        )
        raise CaptureError(f"{path}: {found}; {advice}. The file holds {listed}")
    return images[0]


def find_vector(arrays: Sequence[FoundArray], image: FoundArray, names: re.Pattern[str]) -> FoundArray | None:
    """The list of one number a band with such a name; of several the one in the nearest group."""
    found = [
        array
        for array in arrays
        if array.is_vector and array.length in image.shape and names.fullmatch(array.own_name)
    ]
    return max(found, key=lambda array: _common_groups(array.name, image.name), default=None)


def describing_vectors(
    arrays: Sequence[FoundArray], image: FoundArray
) -> tuple[FoundArray | None, FoundArray | None, FoundArray | None]:
    """Lists of the centres, widths and marks of an image's bands."""
    centres, widths, good = (find_vector(arrays, image, names) for names in (_CENTRES, _WIDTHS, _GOOD))
    return centres, widths, good


def names_wavelengths(name: str) -> bool:
    """Whether an attribute of this name holds wavelengths."""
    return _CENTRES.fullmatch(name.lower()) is not None


def pixel_list_size(
    array: FoundArray, arrays: Sequence[FoundArray], options: ReadOptions
) -> tuple[int, int] | None:
    """Rows and columns of an image that is stored as a matrix of bands and pixels; None if it is not such a matrix."""
    size = options.size or _stated_size(arrays)
    if len(array.shape) != 2 or size is None or size[0] * size[1] not in array.shape:
        return None
    return size


def _stated_size(arrays: Sequence[FoundArray]) -> tuple[int, int] | None:
    """Rows and columns as files of unmixing scenes give them: numbers `nRow` and `nCol`."""
    numbers = {array.own_name.rstrip("s"): array for array in arrays if array.is_vector and array.length == 1}
    if "nrow" not in numbers or "ncol" not in numbers:
        return None
    rows, columns = (float(numbers[name].whole().reshape(-1)[0]) for name in ("nrow", "ncol"))
    return (int(rows), int(columns)) if 1 <= rows < 2**31 and 1 <= columns < 2**31 else None


def _common_groups(first: str, second: str) -> int:
    pairs = zip(first.strip("/").split("/")[:-1], second.strip("/").split("/")[:-1], strict=False)
    return next(
        (count for count, (a, b) in enumerate(pairs) if a != b), min(first.count("/"), second.count("/"))
    )


_NO_DATA = ("_fillvalue", "missing_value", "data_ignore_value", "nodata", "no_data")
_SCALES = ("scale_factor", "reflectance_scale_factor")
_ROLES = {
    **dict.fromkeys(
        ("band", "bands", "wavelength", "wavelengths", "wl", "lambda", "channel", "spectral"), "b"
    ),
    **dict.fromkeys(
        ("y", "lat", "latitude", "row", "rows", "line", "lines", "downtrack", "northing", "height"), "y"
    ),
    **dict.fromkeys(("x", "lon", "longitude", "col", "cols", "column", "columns", "sample", "samples"), "x"),
    **dict.fromkeys(("crosstrack", "easting", "width"), "x"),
}


def image_of_arrays(
    path: Path, reader: str, arrays: Sequence[FoundArray], options: ReadOptions
) -> SpectralFile:
    """The image of a file.

    Raises:
        CaptureError: no array, or more than one, can be the image.
    """
    image = find_image(path, arrays, options)
    shape, take = _as_cube(path, image, arrays, options)
    stated = _state_bands(arrays, image)
    given = options.wavelengths_nm if options.wavelengths_nm is not None else stated.centres
    default = _named_axes(image) if shape == image.shape else None
    if len(image.shape) == 2 and shape != image.shape:
        axes, axis_notes = _pixel_list_axes(image, shape), ()
    else:
        fixed = options.axes or default
        axes, axis_notes = choose_axes(shape, fixed, None if given is None else len(given))
    size = image_shape(shape, axes)
    bands, band_notes = check_bands(stated, size[2])
    scale, scale_notes = _scale(image.attributes)
    return SpectralFile(
        path=path,
        reader=reader,
        shape=size,
        dtype=image.dtype,
        read_part=lambda rows, wanted: take(axes, rows, wanted),
        bands=bands,
        scale=scale,
        no_data=_first_number(image.attributes, _NO_DATA),
        notes=axis_notes + band_notes + scale_notes,
        metadata={"dataset": image.name, "axes": axes} if len(arrays) > 1 else {"axes": axes},
    )


def _as_cube(
    path: Path, image: FoundArray, arrays: Sequence[FoundArray], options: ReadOptions
) -> tuple[tuple[int, ...], TakePart]:
    """Shape of three axes and how parts of it are read; a matrix is a list of pixels or an image of one band."""
    if len(image.shape) == 3:
        whole = image.whole
        return image.shape, image.take or (lambda axes, rows, bands: take_part(whole(), axes, rows, bands))
    if len(image.shape) != 2:
        raise CaptureError(
            f"{path}: {image.name or 'the array'} has the shape {image.shape}; expected three axes"
        )
    size = pixel_list_size(image, arrays, options)
    if options.size is not None and size is None:
        pixels = options.size[0] * options.size[1]
        raise CaptureError(
            f"{path}: {image.name or 'the array'} {image.shape} is not a list of {pixels} pixels"
        )
    rows, columns = size or (0, 0)
    shape = (
        (*image.shape, 1)
        if size is None
        else (
            (image.shape[0], columns, rows)
            if image.shape[1] == rows * columns
            else (columns, rows, image.shape[1])
        )
    )
    return shape, lambda axes, wanted, bands: take_part(image.whole().reshape(shape), axes, wanted, bands)


def _pixel_list_axes(image: FoundArray, shape: tuple[int, ...]) -> Axes:
    """Pixels are listed column after column."""
    if shape[:2] == image.shape:
        return "yxb"
    return "bxy" if shape[0] == image.shape[0] else "xyb"


def _named_axes(image: FoundArray) -> Axes | None:
    roles = "".join(_ROLES.get(name.lower().rpartition("/")[2], "?") for name in image.dimensions or ())
    found: Any = roles
    return found if sorted(roles) == ["b", "x", "y"] else None


def _state_bands(arrays: Sequence[FoundArray], image: FoundArray) -> StatedBands:
    """What arrays or attributes say of the bands."""
    centres, widths, good = describing_vectors(arrays, image)

    def numbers(vector: FoundArray | None) -> list[object] | None:
        return None if vector is None else vector.whole().reshape(-1).tolist()

    if centres is None:
        attribute = next((key for key in image.attributes if names_wavelengths(key)), None)
        values = np.atleast_1d(image.attributes[attribute]) if attribute is not None else np.zeros(0)
        listed = values.tolist() if values.ndim == 1 and len(values) in image.shape else None
        unit = _unit(attribute or "", {})
        return StatedBands(f"attribute '{attribute}'", listed, unit, numbers(widths), numbers(good))
    unit = _unit(centres.own_name, centres.attributes)
    return StatedBands(f"data set '{centres.name}'", numbers(centres), unit, numbers(widths), numbers(good))


def _unit(name: str, attributes: Mapping[str, Any]) -> str | None:
    for key, value in attributes.items():
        if key.lower() in ("unit", "units"):
            return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    suffix = name.lower()[-2:]
    return suffix if suffix in ("nm", "um") else None


def _scale(attributes: Mapping[str, Any]) -> tuple[float | None, tuple[str, ...]]:
    """Stored number that stands for 1: factors above 1 divide, those below multiply, as climate files have it."""
    factor = _first_number(attributes, _SCALES)
    offset = _first_number(attributes, ("add_offset",))
    notes = (
        (f"an offset of {offset:g} is to be added to scaled values, which is left to you",) if offset else ()
    )
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


def open_torch(path: Path, options: ReadOptions) -> SpectralFile:
    """Open a tensor, or the image among the tensors of a dictionary.

    Raises:
        CaptureError: the file is damaged, holds other objects than tensors, or none can be the image.
    """
    return image_of_arrays(
        path, "torch", [_found(path, name, tensor) for name, tensor in _tensors(path)], options
    )


def _tensors(path: Path) -> list[tuple[str, Any]]:
    """Tensors by name, mapped where the file allows it."""
    import pickle

    import torch

    try:
        content = _load(path)
    except pickle.UnpicklingError as error:
        raise CaptureError(
            f"{path}: holds other objects than tensors, which are never loaded because they can run code; "
            "save a plain tensor with torch.save"
        ) from error
    named = content.items() if isinstance(content, dict) else [("", content)]
    return [(str(name), value) for name, value in named if isinstance(value, torch.Tensor)]


def _load(path: Path) -> Any:
    import torch

    with path.open("rb") as file:
        is_mappable = file.read(2) == b"PK"
    return torch.load(path, map_location="cpu", weights_only=True, mmap=is_mappable)


def _found(path: Path, name: str, tensor: Any) -> FoundArray:
    numbers = _numbers(tensor[:0] if tensor.ndim else tensor)

    def whole() -> np.ndarray:
        return _numbers(dict(_tensors(path))[name])

    return FoundArray(name, tuple(tensor.shape), numbers.dtype, whole)


def _numbers(tensor: Any) -> np.ndarray:
    """As an array; what NumPy has no type for becomes float32."""
    import torch

    tensor = tensor.detach()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor.resolve_neg()).numpy()


def open_netcdf3(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    with _opened(path) as file:
        arrays = [_found_netcdf3(path, name, variable) for name, variable in file.variables.items()]
    return image_of_arrays(path, "netcdf", arrays, options)


def _found_netcdf3(path: Path, name: str, variable: Any) -> FoundArray:
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


_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_IS_COMPLEX = 0x0800
_HEAD_BYTES = 2**16
"""Enough for what precedes the numbers of an array."""


@dataclass(frozen=True)
class MatlabArray:
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


def list_arrays(path: Path) -> list[MatlabArray]:
    """Arrays of real numbers; cells, structures and texts are passed over.

    Raises:
        ValueError: the file is damaged or cut short.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:128])
        if order is None:
            raise ValueError("the header is damaged")
        found = (
            _array(file, order, start, kind, length) for start, kind, length in _elements(file, order, size)
        )
        return [array for array in found if array is not None]


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


def _array(file: BinaryIO, order: str, start: int, kind: int, length: int) -> MatlabArray | None:
    file.seek(start)
    head = file.read(min(length, _HEAD_BYTES))
    if kind == _MATRIX:
        return _matrix(head, order, start, length, None)
    if kind != _COMPRESSED:
        return None
    head = zlib.decompressobj().decompress(head, _HEAD_BYTES)
    kind, inner = _tag(head, order, 0)[:2]
    return _matrix(head[8:], order, 8, inner, (start, length)) if kind == _MATRIX else None


def _matrix(
    head: bytes, order: str, start: int, length: int, packed: tuple[int, int] | None
) -> MatlabArray | None:
    """An array by the first bytes of its content."""
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
    return MatlabArray(name, shape, np.dtype(_CLASSES[flags & 0xFF]), stored, start + at, packed)


def _tag(head: bytes, order: str, position: int) -> tuple[int, int, int, int]:
    """Type and length of an element; where its content begins, and where the next element does."""
    if position + 8 > len(head):
        raise ValueError("cut short within a variable")
    kind, length = struct.unpack_from(order + "II", head, position)
    if kind >> 16:  # a small element has its content in its head
        return kind & 0xFFFF, kind >> 16, position + 4, position + 8
    return kind, length, position + 8, position + 8 + length + (-length % 8)


def open_matlab(path: Path, options: ReadOptions) -> SpectralFile:
    """Open the variable that is the image.

    Raises:
        CaptureError: the file is damaged, or no variable, or more than one, can be the image.
    """
    try:
        arrays = list_arrays(path)
    except (ValueError, zlib.error) as error:
        raise CaptureError(f"{path}: a damaged MATLAB file: {error}; copy it again") from error
    return image_of_arrays(path, "matlab", [_found_matlab(path, array) for array in arrays], options)


def _found_matlab(path: Path, array: MatlabArray) -> FoundArray:
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
