"""Where the numbers of a file lie: mapped where they stand uncompressed in it, otherwise decoded into a scratch file.

What is compressed is decoded once a run, some rows at a time, into one temporary file that is mapped from then on and
goes with the process. Reading a view row by row costs what its rows have, however it is stored. Where the disk has no
room for all that was decoded, the file is begun anew, and what is read again is decoded again.

Notation: axes of stored arrays are letters, the slowest first: `y` rows, `x` columns, `b` bands.
"""

from __future__ import annotations

import atexit
import os
import tempfile
import threading
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import IO, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Int, Shaped

from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_scratch, has_scratch_room

Axes: TypeAlias = Literal["yxb", "byx", "ybx", "xyb", "bxy", "xby"]
"""What the axes of an array are, the slowest first: y rows, x columns, b bands."""
BandIndex: TypeAlias = slice | Int[np.ndarray, " b"]
"""Some bands: a slice, or their indices in any order."""
_PIECE_BYTES = 1 << 25
"""Decoded at once, where a file can be decoded in parts."""
_PAGE_BYTES = 1 << 16
"""Numbers in the scratch file begin at multiples of it, as maps do."""


@dataclass(frozen=True)
class Mapped:
    """An array that stands in a file, number after number."""

    path: Path
    dtype: np.dtype
    """In the byte order of the file."""
    shape: tuple[int, ...]
    offset: int
    """Bytes before the first number."""
    order: Literal["C", "F"] = "C"
    """Whether the last axis runs fastest, or the first."""

    def array(self) -> np.ndarray:
        """All its numbers; the map ends with the array, so that many files can be in use at a time."""
        end = self.offset + prod(self.shape) * self.dtype.itemsize
        found = self.path.stat().st_size
        if found < end:  # touching a map beyond the end of its file would end the process
            raise CaptureError(f"{self.path}: {found} bytes are left of {end}; the file was cut")
        return np.memmap(self.path, self.dtype, "r", self.offset, self.shape, self.order)


@dataclass(frozen=True)
class Decoded:
    """An array that a function writes, as a whole or some indices of one axis at a time."""

    path: Path
    dtype: np.dtype
    shape: tuple[int, ...]
    decode: Callable[..., None]
    """Of a module: `decode(path, array, *arguments)` writes an array of 0. Where there are units, it is
    `decode(path, array, axis, first, *arguments)` for indices of an axis from `first` on, as many as the array has."""
    arguments: tuple[Hashable, ...] = ()
    order: Literal["C", "F"] = "C"
    units: tuple[int, ...] | None = None
    """Indices of each axis that the file holds together, such as rows of a strip; None where all must be decoded."""

    def array(self) -> np.ndarray:
        """All its numbers, decoded if that was not done before."""
        return next(self.pieces(0, 0, self.shape[0], self.shape[0]))[1]

    def pieces(self, axis: int, first: int, last: int, step: int = 0) -> Iterator[tuple[int, np.ndarray]]:
        """The pieces along an axis that have its indices from `first` to before `last`, each with its first index."""
        length = self.shape[axis]
        if not step and self.units is not None:
            of_one = prod(self.shape) // max(1, length) * self.dtype.itemsize * self.units[axis]
            step = self.units[axis] * max(1, _PIECE_BYTES // max(1, of_one))
        step = min(step or length, length)
        for start in range(first // step * step, last, step):
            yield start, _scratch.piece(self, axis, start, min(start + step, length))


@dataclass(frozen=True)
class Held:
    """A small array in memory."""

    values: np.ndarray = field(repr=False)

    def array(self) -> np.ndarray:
        """All its numbers or texts."""
        return self.values


Block: TypeAlias = Mapped | Decoded | Held


@dataclass(frozen=True)
class Numbers:
    """The stored numbers of an image, in one block or in one for each index of their first axis."""

    blocks: tuple[Block, ...]
    shape: tuple[int, ...]
    """Of all blocks together, three axes."""
    axes: Axes
    dtype: np.dtype
    """What the numbers are read as; blocks may have a smaller type, or another byte order."""

    def read(self, rows: slice, bands: BandIndex) -> Shaped[np.ndarray, "h W b"]:
        """A copy of some rows, and of bands in rising order; slices have both ends and no step."""
        block = self.blocks[0]
        if len(self.blocks) > 1:
            # Of the blocks that are asked for; within one, all bands are read, of which there are few.
            of_axis = {"b": bands, "y": rows, "x": slice(None)}
            chosen = np.arange(len(self.blocks))[of_axis[self.axes[0]]]
            within = rows if self.axes[1] == "y" else slice(None)
            planes = [self.blocks[index].array().reshape(self.shape[1:])[within] for index in chosen]
            left_rows = rows if self.axes[2] == "y" else slice(None)
            left_bands = slice(None) if self.axes[0] == "b" else bands
            part = _take(np.stack(planes), self.axes, left_rows, left_bands)
        elif isinstance(block, Decoded) and block.shape == self.shape:
            pieces = block.pieces(self.axes.index("y"), rows.start, rows.stop)
            parts = [
                _take(piece, self.axes, slice(max(0, rows.start - first), rows.stop - first), bands)
                for first, piece in pieces
            ]
            part = parts[0] if len(parts) == 1 else np.concatenate(parts)
        else:
            part = _take(block.array().reshape(self.shape), self.axes, rows, bands)
        return part.astype(self.dtype.newbyteorder("="), copy=False)


def _take(stored: np.ndarray, axes: str, rows: slice, bands: BandIndex) -> Shaped[np.ndarray, "h W b"]:
    return np.array(stored.transpose([axes.index(axis) for axis in "yxb"])[rows][:, :, bands], order="C")


class _Scratch:
    """The file of all that this process has decoded. It has no name where the system allows that, so that nothing of it
    is left however the process ends."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._file: IO[bytes] | None = None
        self._end = 0
        self._places: dict[Hashable, int] = {}

    def piece(self, numbers: Decoded, axis: int, first: int, last: int) -> np.ndarray:
        """The indices of an axis from `first` to before `last`, decoded if that was not done before."""
        state = numbers.path.stat()
        whose = numbers.path.resolve(), state.st_size, state.st_mtime_ns
        key = (*whose, numbers.decode, numbers.arguments, axis, first, last)
        shape = (*numbers.shape[:axis], last - first, *numbers.shape[axis + 1 :])
        with self._lock:
            if key not in self._places:
                at = self._reserve(numbers.path, prod(shape) * numbers.dtype.itemsize)
                target = self._map(numbers, shape, at, "r+")
                part = () if numbers.units is None else (axis, first)
                numbers.decode(numbers.path, target, *part, *numbers.arguments)
                self._places[key] = at
                self._end = at + -(-target.nbytes // _PAGE_BYTES) * _PAGE_BYTES
            return self._map(numbers, shape, self._places[key], "r")

    def close(self) -> None:
        """Give the disk back, as soon as no map is left."""
        with self._lock:
            if self._file is not None:
                self._file.close()
            self._file, self._end, self._places = None, 0, {}

    def _map(self, numbers: Decoded, shape: tuple[int, ...], at: int, mode: Literal["r", "r+"]) -> np.ndarray:
        assert self._file is not None
        return np.memmap(self._file, numbers.dtype, mode, at, shape, numbers.order)

    def _reserve(self, path: Path, needed: int) -> int:
        """Where numbers begin that are to be decoded, with the disk taken for them: a map that the disk has no room for
        would end the process. Raises CaptureError: there is no room even for these alone."""
        folder = Path(tempfile.gettempdir())
        if self._file is not None and not has_scratch_room(folder, needed):
            self.close()
        allow_scratch(path, needed, folder, CaptureError)
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="unmix-", dir=folder)  # noqa: SIM115 (open until the end)
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._file.fileno(), self._end, max(1, needed))
            else:
                self._file.seek(self._end)
                for start in range(0, needed, 1 << 22):
                    self._file.write(bytes(min(1 << 22, needed - start)))
                self._file.flush()
        except OSError as error:
            raise CaptureError(f"{path}: can't be decoded in {folder}: {error.strerror or error}") from error
        return self._end


_scratch = _Scratch()
atexit.register(_scratch.close)


def find_zeros(masks: tuple[Numbers, ...], rows: slice, bands: BandIndex) -> Bool[np.ndarray, "h W"]:
    """Pixels where a mask is 0 in one of some bands; a mask of one band is that of all.

    Source: GDAL, RFC 15: band masks: 0 is no data.
    """
    found = []
    for mask in masks:
        is_of_all = mask.shape[mask.axes.index("b")] == 1
        found.append((mask.read(rows, slice(0, 1) if is_of_all else bands) == 0).any(axis=-1))
    return np.any(found, axis=0)
