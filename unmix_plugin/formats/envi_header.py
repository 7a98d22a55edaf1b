"""The text beside an ENVI file: `key = value` lines after the word ENVI.

Lists stand in braces and are parted by commas, for which there is no escape; so what would end a list or an element is
replaced in names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from unmix_plugin.spectral.bands import Bands

HeaderValue: TypeAlias = str | int | Sequence[str] | Sequence[float] | np.ndarray

_DATA_TYPES = {"float32": 4, "uint8": 1}


def header_bytes(values: Mapping[str, HeaderValue]) -> bytes:
    """The header with these entries, in their order; numbers with all their digits.

    >>> print(header_bytes({"lines": 2, "wavelength": [450.0, 550.5], "band names": ["a,b", "c"]}).decode())
    ENVI
    lines = 2
    wavelength = { 450.0, 550.5 }
    band names = { a-b, c }
    """
    return (
        "\n".join(["ENVI", *(f"{key} = {_text(key, value)}" for key, value in values.items())]) + "\n"
    ).encode()


def layout_entries(
    samples: int, lines: int, bands: int, dtype: np.dtype, interleave: str
) -> dict[str, HeaderValue]:
    """How the numbers lie on disk; little-endian, nothing before them."""
    return {
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "header offset": 0,
        "data type": _DATA_TYPES[dtype.name],
        "interleave": interleave,
        "byte order": 0,
    }


def wavelength_entries(bands: Bands) -> dict[str, HeaderValue]:
    """Band centres and widths in nm; a width is that of the band's interval, an estimate from the spacing."""
    return {
        "wavelength units": "Nanometers",
        "wavelength": bands.centers_nm,
        "fwhm": bands.widths_nm.round(6),
    }


def beside(path_without_suffix: Path, suffix: str) -> Path:
    """A file with this suffix; dots in the name before it stay."""
    return path_without_suffix.with_name(path_without_suffix.name + suffix)


def _text(key: str, value: HeaderValue) -> str:
    if isinstance(value, str):
        return "{ " + _plain(value) + " }" if key == "description" else _plain(value)
    if isinstance(value, int):
        return str(value)
    return "{ " + ", ".join(_elements(value)) + " }"


def _elements(values: Iterable[str | float]) -> list[str]:
    return [
        _plain(value).replace(",", "-") if isinstance(value, str) else repr(float(value)) for value in values
    ]


def _plain(text: str) -> str:
    """One line without braces."""
    return re.sub(r"\s+", " ", text.replace("{", "(").replace("}", ")")).strip()
