"""How NumPy, NetCDF-3, HDF5 (with NetCDF-4 and MATLAB 7.3) and MATLAB 5 to 7 store arrays by name.

Files are opened to list their arrays and closed again, so that many can be in use at a time.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count, product
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from unmix_plugin.captures.cube import (
    Cube,
    ReadOptions,
    import_extra,
)
from unmix_plugin.captures.numbers import Block, Decoded, Held, Mapped
from unmix_plugin.captures.readers.arrays import (
    UNREAD,
    UNREADABLE,
    FoundArray,
    describes_image,
    image_of_arrays,
)
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import (
    MOST_TEXT_BYTES,
    allow_decoded,
    allow_depth,
    allow_parts,
    open_zip,
)
from unmix_plugin.scenes.reading.cubes import (
    READ_HEADER,
    UnreadableArrayError,
    parse_header,
    read_array_header,
)

# NumPy: .npy is mapped, of .npz the member that is an image is loaded. No pickle is ever read.


def open_container(kind: str, path: Path, options: ReadOptions) -> Cube:
    """Open the image of a file of one of `KINDS`, by its headers. Raises CaptureError: the file is damaged or cut
    short, holds objects, or no array of it, or more than one, can be the image."""
    reader, list_arrays = KINDS[kind]
    return image_of_arrays(path, reader, list_arrays(path), options)


def _list_npy(path: Path) -> list[FoundArray]:
    try:
        header = read_array_header(path)
    except UnreadableArrayError as error:
        raise CaptureError(f"{path}: {error}") from error
    order = "F" if header.is_fortran else "C"
    numbers = Mapped(path, header.dtype, header.shape, header.offset, order)
    return [FoundArray("", header.shape, header.dtype, numbers)]


def _list_npz(path: Path) -> list[FoundArray]:
    """Members by their headers."""
    arrays = []
    with open_zip(path, CaptureError) as archive:
        for info in archive.infolist():
            with archive.open(info) as file:
                version = np.lib.format.read_magic(file)
                if version not in READ_HEADER:
                    raise CaptureError(
                        f"{path}: {info.filename} is .npy of version {version}; use numpy.savez"
                    )
                shape, is_fortran, dtype = parse_header(file, version)
            needed = int(np.prod(shape, dtype=object)) * dtype.itemsize
            if not dtype.hasobject and info.file_size < needed:
                held = f"holds {info.file_size} bytes"
                raise CaptureError(f"{path}: {info.filename} {held}; its header promises {needed}")
            allow_decoded(path, info.file_size, CaptureError, info.compress_size)
            order = "F" if is_fortran else "C"
            numbers = Decoded(path, dtype, shape or (1,), _unpack_member, (info.filename,), order)
            arrays.append(FoundArray(info.filename.removesuffix(".npy"), shape, dtype, numbers))
    return arrays


def _unpack_member(path: Path, numbers: np.ndarray, name: str) -> None:
    flat = numbers.reshape(-1, order="A").view(np.uint8)
    with zipfile.ZipFile(path) as archive, archive.open(name) as file:
        parse_header(file, np.lib.format.read_magic(file))
        at = 0
        while at < len(flat):
            piece = file.read(min(_PIECE_BYTES, len(flat) - at))
            if not piece:
                raise CaptureError(f"{path}: {name} is cut short; copy the file again")
            flat[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
            at += len(piece)


# NetCDF of the classic kind, copied by SciPy, as the numbers of a variable need not stand together.

_NETCDF_FILLS = {"i2": -32767.0, "i4": -2147483647.0, "f4": 9.969209968386869e36, "f8": 9.969209968386869e36}
"""Numbers of variables that were never written, by type. Source: NetCDF's netcdf.h, NC_FILL_SHORT and the like."""


def _list_netcdf3(path: Path) -> list[FoundArray]:
    from scipy.io import netcdf_file

    def found(name: str, variable: Any, root: dict[str, Any]) -> FoundArray:
        shape, axes, attributes = variable.shape, variable.dimensions, dict(variable._attributes)
        kind = variable.data.dtype
        fill = _NETCDF_FILLS.get(kind.str[1:])
        numbers = Decoded(path, kind, shape or (1,), _copy_variable, (name,))
        return FoundArray(name, shape, kind, numbers, attributes, root, axes, fill)

    with netcdf_file(str(path), "r", mmap=True) as file:
        allow_parts(path, len(file.variables), "variables", CaptureError)
        return [found(name, variable, dict(file._attributes)) for name, variable in file.variables.items()]


def _copy_variable(path: Path, numbers: np.ndarray, name: str) -> None:
    from scipy.io import netcdf_file

    with netcdf_file(str(path), "r", mmap=True) as file:
        numbers[...] = file.variables[name].data


# HDF5: contiguous numbers are mapped, chunks are read by h5py, each once.

_SMALL_TEXT_BYTES = 1 << 16
_BLOCK_BYTES = 1 << 26
"""Of a data set, that are decoded at once; more where a single chunk is larger."""
_BARE_AXIS = "This is a netCDF dimension but not a netCDF variable"
"""What begins the attribute NAME of data sets that hold nothing. Source: netCDF-C, DIM_WITHOUT_VARIABLE."""


def open_hdf5(path: Path, options: ReadOptions) -> Cube:
    """Open the data set that is the image; MATLAB's have their axes in reverse order, which is undone. Raises
    CaptureError: the file is damaged, or no data set, or more than one, can be the image."""
    h5py = import_extra("h5py")
    with path.open("rb") as begin:
        is_matlab = begin.read(10) == b"MATLAB 7.3"
    arrays: list[FoundArray] = []
    visited = count(1)
    seen: set[Any] = set()

    def visit(group: Any, inside: str, inherited: dict[str, Any]) -> None:
        # Not by `visititems`, which never ends where a damaged tree of names leads back to itself.
        seen.add(group)
        attributes = _attributes(path, group)
        inherited = attributes | {key: value for key, value in inherited.items() if key not in attributes}
        for link in group:
            if not isinstance(group.get(link, getlink=True), h5py.HardLink) or (item := group[link]) in seen:
                continue
            name = f"{inside}{link}"
            allow_parts(path, next(visited), "groups and data sets", CaptureError)
            allow_depth(path, name.count("/") + 1, CaptureError)
            seen.add(item)
            if isinstance(item, h5py.Group):
                visit(item, f"{name}/", inherited)
            else:
                arrays.extend(_found_in_hdf5(path, name, item, is_matlab, inherited))

    with h5py.File(path, "r") as file:
        visit(file, "", {})
    opened = image_of_arrays(path, "matlab" if is_matlab else "hdf5", arrays, options)
    name = opened.dataset or arrays[0].name
    with h5py.File(path, "r") as file:
        image = file[name]
        if image.external or image.is_virtual:
            raise CaptureError(f"{path}: the numbers of {name} lie in other files; write them into this one")
        of_chunk = prod(image.chunks) if image.chunks else 0
        allow_decoded(path, max(image.size, of_chunk) * image.dtype.itemsize, CaptureError)
        if image.chunks:
            grid = [-(-length // step) for length, step in zip(image.shape, image.chunks, strict=True)]
            absent = prod(grid) - image.id.get_num_chunks()
        else:
            absent = int(image.id.get_storage_size() == 0)
        fill = float(np.array(image.fillvalue).astype(opened.dtype))  # where nothing was written
    if not absent or fill in opened.no_data or not np.isfinite(fill):
        return opened
    taken = "in all bands " * (fill == 0) + "count as not measured"
    remark = Remark.of(Code.CHUNKS_ABSENT, chunks=absent, fill=f"{fill:g}", taken=taken)
    return replace(opened, no_data=(*opened.no_data, fill)).remarking(remark)


def _found_in_hdf5(
    path: Path, name: str, item: Any, is_matlab: bool, inherited: dict[str, Any]
) -> list[FoundArray]:
    if not hasattr(item, "shape") or item.shape is None or "#refs#" in name:
        return []
    attributes, dtype = _attributes(path, item), item.dtype
    if _BARE_AXIS in str(attributes.get("NAME", "")):
        return []
    is_letters = is_matlab and attributes.get("MATLAB_class") == b"char"
    if is_letters or import_extra("h5py").check_string_dtype(dtype) is not None:
        dtype = np.dtype("O")
    elif dtype.kind == "O":  # references, as MATLAB's cells are, or lists of different lengths
        dtype = UNREAD
    shape = tuple(item.shape[::-1] if is_matlab else item.shape)
    is_cube = len(shape) == 3
    inherited = inherited if is_cube else {}
    if not is_cube and (item.external or item.is_virtual):
        return []

    axes, fill = [], None  # named by NetCDF's dimension scales or by labels
    for dimension in item.dims:
        scales = [scale.name for scale in dimension.values()] if len(dimension) else []
        axes.append((scales[0] or "") if scales else dimension.label)
    if dtype.kind in "iuf":
        # HDF5 ends the process where a damaged value is asked for; asked whether there is one, it raises an error.
        item.id.get_create_plist().fill_value_defined()
        fill = float(item.fillvalue)
    numbers = _hdf5_numbers(path, name, item, dtype, is_matlab, is_letters)
    names = tuple(axes) if any(axes) else None
    return [FoundArray(name, shape, dtype, numbers, attributes, inherited, names, fill)]


def _hdf5_numbers(
    path: Path, name: str, item: Any, dtype: np.dtype, is_matlab: bool, is_letters: bool
) -> Block:
    """Where the numbers of a data set are; texts are read at once."""
    order: Literal["C", "F"] = "F" if is_matlab else "C"
    shape = tuple(item.shape[::-1] if is_matlab else item.shape)
    if dtype == UNREAD or (dtype == "O" and not describes_image(name)):
        return Held(np.zeros(0))
    if dtype == "O":
        needed, is_stored = prod(shape) * item.dtype.itemsize, item.id.get_storage_size()
        if needed > _SMALL_TEXT_BYTES:
            allow_decoded(path, needed, CaptureError, is_stored)
        stored = np.asarray(item[()])
        if is_letters:
            return Held(np.array(["".join(map(chr, row)) for row in np.atleast_2d(stored.T)]))
        return Held(stored.T if is_matlab else stored)
    if not shape:
        return Held(np.atleast_1d(item[()]))
    offset = item.id.get_offset() if item.chunks is None else None
    if offset is not None and not item.external and not item.is_virtual:
        return Mapped(path, item.dtype, shape, offset, order)
    chunks = item.chunks or (1,) * item.ndim
    units = chunks[::-1] if is_matlab else chunks
    return Decoded(path, item.dtype, shape, _read_chunks, (name, is_matlab), order, units)


def _read_chunks(path: Path, numbers: np.ndarray, axis: int, first: int, name: str, is_matlab: bool) -> None:
    """Some numbers of a data set, in blocks of whole chunks, so that each chunk is decoded once."""
    target, axis = (numbers.T, numbers.ndim - 1 - axis) if is_matlab else (numbers, axis)
    with import_extra("h5py").File(path, "r") as file:
        stored = file[name]
        block = list(stored.chunks or stored.shape)
        for other in reversed(range(len(block))):
            fitting = _BLOCK_BYTES // max(1, prod(block) * stored.dtype.itemsize)
            block[other] = min(target.shape[other], block[other] * max(1, fitting))
        starts = (range(0, length, step) for length, step in zip(target.shape, block, strict=True))
        for corner in product(*starts):
            ends = [
                min(one + step, length) for one, step, length in zip(corner, block, target.shape, strict=True)
            ]
            within = [slice(*both) for both in zip(corner, ends, strict=True)]
            of_file = [*within]
            of_file[axis] = slice(first + corner[axis], first + ends[axis])
            target[tuple(within)] = stored[tuple(of_file)]


def _attributes(path: Path, item: Any) -> dict[str, Any]:
    """Attributes, `UNREADABLE` where h5py can't read one: programs write types that it has no word for."""
    attributes = {}
    allow_parts(path, len(item.attrs), "attributes", CaptureError)
    for name in item.attrs:
        attributes[name] = UNREADABLE
        with suppress(OSError, TypeError, ValueError, RuntimeError):
            if item.attrs.get_id(name).get_storage_size() <= MOST_TEXT_BYTES:
                attributes[name] = item.attrs[name]
    return attributes


# MATLAB 5 to 7, read here rather than by SciPy, which ends the process on some damaged files and can't map numbers.
# Those that lie open are mapped, compressed ones are unpacked when the first of them are asked for.
# Source: The MathWorks, MAT-File Format, chapter 1 (level 5).

_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CELLS_TO_SPARSE, _LETTERS = range(1, 6), 4
_ENCODINGS = {2: "latin-1", 4: "utf-16-", 16: "utf-8", 17: "utf-16-", 18: "utf-32-"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_IS_COMPLEX = 0x0800
_HEAD_BYTES = 2**16
"""Enough for what precedes the numbers of an array."""
_PIECE_BYTES = 2**20


def _list_matlab(path: Path) -> list[FoundArray]:
    """Variables, of which cells, structures and complex numbers are not read."""
    arrays: list[FoundArray] = []
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:128])
            if order is None:
                raise ValueError("the header is damaged")
            elements = list(_elements(file, order, size))
            allow_parts(path, len(elements), "variables", CaptureError)
            for element in elements:
                arrays += _found_in_matlab(path, file, order, *element)
    except (ValueError, zlib.error) as error:
        raise CaptureError(f"{path}: a damaged MATLAB file: {error}; copy it again") from error
    return arrays


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


def _found_in_matlab(
    path: Path, file: BinaryIO, order: str, start: int, kind: int, length: int
) -> list[FoundArray]:
    """An array of real numbers or letters by the first bytes of its element, one of no numbers for anything else.

    Axes are in MATLAB's order, the first axis fastest. Files may hold a smaller type than the variable has.
    """
    file.seek(start)
    head, packed = file.read(min(length, _HEAD_BYTES)), None
    if kind == _COMPRESSED:
        head, packed = zlib.decompressobj().decompress(head, _HEAD_BYTES), (start, length)
        kind, length = _tag(head, order, 0)[:2]
        head, start = head[8:], 8
    if kind != _MATRIX:
        return []
    _, _, at, end = _tag(head, order, 0)
    (flags,) = struct.unpack_from(order + "I", head, at)
    if (class_number := flags & 0xFF) not in (*_CELLS_TO_SPARSE, *_CLASSES):
        return []
    _, size, at, end = _tag(head, order, end)
    shape = struct.unpack_from(f"{order}{size // 4}i", head, at)
    _, size, at, end = _tag(head, order, end)
    name = head[at : at + size].decode("utf-8", "replace")
    if class_number not in _CLASSES or flags & _IS_COMPLEX:
        texts = []  # of each row of letters, unless they are too many for the first bytes
        if class_number == _LETTERS:
            kind, size, at, _ = _tag(head, order, end)
            encoding = _ENCODINGS.get(kind, "latin-1")
            encoding += {"<": "le", ">": "be"}[order] if encoding.endswith("-") else ""
            letters = list(head[at : at + size].decode(encoding, "replace"))
            if letters and len(letters) == prod(shape):
                rows = np.array(letters).reshape(shape[0], -1, order="F")
                texts = ["".join(row) for row in rows]
        found = np.array(texts) if texts else np.zeros((), UNREAD)
        return [FoundArray(name, found.shape, found.dtype, Held(found))] if name else []
    kind, size, at, _ = _tag(head, order, end)
    if kind not in _STORED or min(shape, default=-1) < 0:
        raise ValueError(f"variable '{name}' has the type {kind} and the shape {shape}")
    stored, dtype, offset = np.dtype(order + _STORED[kind]), np.dtype(_CLASSES[class_number]), start + at
    if prod(shape) * stored.itemsize != size or at + size > length:
        raise ValueError(f"variable '{name}' of {shape} {stored.name} has {size} bytes")
    if packed is None:
        return [FoundArray(name, shape, dtype, Mapped(path, stored, shape, offset, "F"))]
    allow_decoded(path, prod(shape) * max(stored.itemsize, dtype.itemsize), CaptureError, packed[1])
    numbers = Decoded(path, stored, shape, _unpack, (name, offset, packed), "F")
    return [FoundArray(name, shape, dtype, numbers)]


def _tag(head: bytes, order: str, position: int) -> tuple[int, int, int, int]:
    """Type and length of an element; where its content begins, and where the next element does."""
    if position + 8 > len(head):
        raise ValueError("cut short within a variable")
    kind, length = struct.unpack_from(order + "II", head, position)
    if kind >> 16:  # a small element has its content in its head
        return kind & 0xFFFF, kind >> 16, position + 4, position + 8
    return kind, length, position + 8, position + 8 + length + (-length % 8)


def _unpack(path: Path, numbers: np.ndarray, name: str, offset: int, packed: tuple[int, int]) -> None:
    """The numbers of a compressed variable, unpacked piece by piece to where they stay, and no more than it needs."""
    start, unread = packed
    target, at, unpacking = numbers.reshape(-1, order="F").view(np.uint8), -offset, zlib.decompressobj()
    with path.open("rb") as file:
        file.seek(start)
        while at < len(target):
            part = unpacking.unconsumed_tail
            if not part:
                part = file.read(min(_PIECE_BYTES, unread))
                unread -= len(part)
            piece = unpacking.decompress(part, _PIECE_BYTES)
            if not part and not piece:
                raise CaptureError(f"{path}: variable '{name}' is cut short; copy the file again")
            wanted = piece[max(0, -at) : len(target) - at]
            target[max(0, at) : max(0, at) + len(wanted)] = np.frombuffer(wanted, np.uint8)
            at += len(piece)


KINDS: dict[str, tuple[str, Callable[[Path], list[FoundArray]]]] = {
    "npy": ("npy", _list_npy),
    "npz": ("npy", _list_npz),
    "netcdf": ("netcdf", _list_netcdf3),
    "matlab": ("matlab", _list_matlab),
}
"""Name of the reader, and what lists the arrays of a file, by the kind of file."""
