"""How the numbers of an ENVI image lie on disk.

Notation: `H` lines, `W` samples, `B` bands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod

import numpy as np

_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
_COMPLEX_TYPES = (6, 9)
_AXES = {"bsq": "byx", "bil": "ybx", "bip": "yxb"}
_LARGEST = 2**40


@dataclass(frozen=True)
class EnviLayout:
    """Where each number lies."""

    shape: tuple[int, int, int]
    """H, W, B."""
    dtype: np.dtype
    interleave: str
    """bsq, bil or bip."""
    offset: int
    """Bytes before the first number."""
    notes: tuple[str, ...] = ()

    @property
    def num_bytes(self) -> int:
        """Least size of the file."""
        return self.offset + prod(self.shape) * self.dtype.itemsize

    @property
    def axes(self) -> str:
        """Order of the axes on disk, the slowest first."""
        return _AXES[self.interleave]


def read_layout(header: Mapping[str, str]) -> EnviLayout:
    """The layout that a header states.

    Raises:
        ValueError: an entry is missing or impossible.
    """
    _refuse_other_files(header)
    shape = (_count(header, "lines", 1), _count(header, "samples", 1), _count(header, "bands", 1))
    code, notes = _count(header, "data type", 0), []
    if code in _COMPLEX_TYPES:
        raise ValueError(f"'data type' is {code}, complex numbers; expected one of {_known_types()}")
    if code not in _TYPES:
        raise ValueError(f"'data type' is {code}; expected one of {_known_types()}")
    kind = np.dtype(_TYPES[code])
    if "byte order" not in header and kind.itemsize > 1:
        notes.append("the header has no byte order; taken as little-endian")
    order = _count(header, "byte order", 0, default=0)
    if order > 1:
        raise ValueError(f"'byte order' is {order}; expected 0 (little-endian) or 1 (big-endian)")
    offset = _count(header, "header offset", 0, default=0)
    return EnviLayout(
        shape, kind.newbyteorder(">" if order else "<"), _interleave(header), offset, tuple(notes)
    )


def _refuse_other_files(header: Mapping[str, str]) -> None:
    kind = header.get("file type", "").lower()
    if "library" in kind:
        raise ValueError("the file is a library of spectra; expected an image")
    if _count(header, "file compression", 0, default=0):
        raise ValueError("the file of numbers is compressed ('file compression'); write it uncompressed")
    for key in ("major frame offsets", "minor frame offsets"):
        if any(part.strip() not in ("", "0") for part in header.get(key, "").split(",")):
            raise ValueError(
                f"'{key}' is {header[key]}; expected 0: write the image without bytes between frames"
            )


def _interleave(header: Mapping[str, str]) -> str:
    stated = header.get("interleave")
    if stated is None and _count(header, "bands", 1) == 1:
        return "bsq"  # with one band all three are the same
    if (stated or "").lower() not in _AXES:
        found = "missing" if stated is None else f"'{stated}'"
        raise ValueError(f"'interleave' is {found}; expected bsq, bil or bip: correct the header")
    return str(stated).lower()


def _count(header: Mapping[str, str], key: str, least: int, default: int | None = None) -> int:
    """A whole number; a comment behind it is cut off."""
    text = header.get(key, "" if default is None else str(default)).partition(";")[0].strip()
    try:
        number = int(text) if len(text) < 20 else _LARGEST
    except ValueError:
        found = f"'{text}'" if text else "missing"
        raise ValueError(f"'{key}' is {found}; expected a whole number") from None
    if not least <= number < _LARGEST:
        raise ValueError(f"'{key}' is {text}; expected a whole number of at least {least}")
    return number


def _known_types() -> str:
    return ", ".join(f"{code} ({np.dtype(name).name})" for code, name in _TYPES.items())
