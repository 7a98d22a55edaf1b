"""Elements of a MATLAB file of version 5 to 7: which arrays of numbers it holds, and where.

Read here rather than by SciPy, which ends the process on some damaged files, and which can't map numbers.

Source: The MathWorks, MAT-File Format, chapter 1 (level 5).
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
