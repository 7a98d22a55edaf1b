"""Images in MATLAB files of version 5 to 7.

Files of version 7.3 are HDF5. Numbers that lie open are mapped, compressed ones are unpacked
when the first of them are asked for. Read here rather than by SciPy, which ends the process on some damaged files and
can't map numbers. Source: The MathWorks, MAT-File Format, chapter 1 (level 5).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import BinaryIO

import numpy as np

from unmix_plugin.captures.readers.arrays import FoundArray, image_of_arrays
from unmix_plugin.captures.spectral_file import Axes, BandIndex, ReadOptions, SpectralFile, loaded, take_part
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_decoded, allow_parts

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
    """Open the variable that is the image; cells, structures, texts and complex numbers are passed over. Raises
    CaptureError: the file is damaged, or no variable, or more than one, can be the image."""

    def found(array: _MatlabArray) -> FoundArray:
        if array.packed is not None:
            size = max(array.stored.itemsize, array.dtype.itemsize)
            allow_decoded(path, prod(array.shape) * size, CaptureError, array.packed[1])

        def stored() -> np.ndarray:
            if array.packed is not None:
                return loaded(_unpack, path, array)
            return np.memmap(path, array.stored, "r", array.offset, array.shape, order="F")

        def take(axes: Axes, rows: slice, bands: BandIndex) -> np.ndarray:
            return take_part(stored(), axes, rows, bands).astype(array.dtype)

        return FoundArray(array.name, array.shape, array.dtype, lambda: stored().astype(array.dtype), take)

    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:128])
            if order is None:
                raise ValueError("the header is damaged")
            arrays = []
            for element in _elements(file, order, size):
                arrays.append(_matlab_array(file, order, *element))
                allow_parts(path, len(arrays), "variables", CaptureError)
    except (ValueError, zlib.error) as error:
        raise CaptureError(f"{path}: a damaged MATLAB file: {error}; copy it again") from error
    return image_of_arrays(path, "matlab", [found(array) for array in arrays if array is not None], options)


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
