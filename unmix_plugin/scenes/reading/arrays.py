"""Reading .npy files without trusting them: header first, never a pickle, mapped and not loaded."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

READ_HEADER = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}

_ONE_PARSER = Lock()
"""NumPy parses headers as Python literals, which fails in CPython 3.11 if several threads do so at the same moment."""


class UnreadableArrayError(ValueError):
    """A file is no .npy array of numbers; the text says why and what to do."""


@dataclass(frozen=True)
class ArrayHeader:
    """What a .npy file says of itself before any value is read."""

    shape: tuple[int, ...]
    """Axis lengths."""
    dtype: np.dtype
    """Float or integer type."""


def read_array_header(path: Path) -> ArrayHeader:
    """Read and check the header of a .npy file; no value and no pickle is read.

    Raises:
        UnreadableArrayError: not a .npy file, a pickled one, cut short, or of a type that is not float or integer.
        OSError: the file cannot be opened.
    """
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
        except ValueError as error:
            raise UnreadableArrayError("is not a .npy file; write it with numpy.save") from error
        if version not in READ_HEADER:
            raise UnreadableArrayError(f"is a .npy file of version {version}; write it with numpy.save")
        try:
            shape, _, dtype = parse_header(file, version)
        except Exception as error:  # numpy raises SyntaxError, TokenError, ValueError... for a damaged header
            raise UnreadableArrayError("has a damaged .npy header; write it again") from error
        found_bytes = path.stat().st_size - file.tell()
    if not all(type(length) is int and length >= 0 for length in shape):
        raise UnreadableArrayError(f"has the shape {shape} in its .npy header; write it again")
    if dtype.hasobject:
        raise UnreadableArrayError(
            "holds pickled Python objects, which are never loaded because they can run code; "
            "save a plain numeric array with numpy.save(..., allow_pickle=False)"
        )
    if dtype.kind not in "fiu":
        raise UnreadableArrayError(f"holds {dtype} values; expected a float or an integer type")
    expected_bytes = prod(shape) * dtype.itemsize
    if found_bytes < expected_bytes:
        raise UnreadableArrayError(
            f"is cut short: {found_bytes} bytes of values found, {expected_bytes} expected for shape {shape}"
        )
    return ArrayHeader(shape, dtype)


def parse_header(file: Any, version: tuple[int, int]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the first axis runs fastest, and type, of an open binary file behind its magic string.

    Raises:
        Exception: of NumPy, of many kinds, for a damaged header.
    """
    with _ONE_PARSER:
        return READ_HEADER[version](file)


def map_array(path: Path) -> np.ndarray:
    """Map a checked .npy file into memory, read-only; values are read when touched."""
    with _ONE_PARSER:
        return np.load(path, mmap_mode="r", allow_pickle=False)
