"""The text beside an ENVI file: `key = value` lines after the word ENVI.

Lists are in braces, separated by commas, and neither can be escaped: names have them replaced.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import numpy as np

from unmix_plugin.engine.runs.atomic_files import write_errors_as, write_file
from unmix_plugin.formats.raw_rows import RowSink, raw_rows
from unmix_plugin.spectral.bands import Bands

HeaderValue: TypeAlias = str | int | Sequence[str] | Sequence[float] | np.ndarray

_FLOAT32 = 4
"""What the format calls this type."""


@contextmanager
def envi_rows(
    paths: Sequence[Path], shape: tuple[int, ...], entries: Mapping[str, HeaderValue]
) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of a file of float32.

    The header is written last, and an old one is removed before its numbers are replaced: whenever both files are
    there, they belong together.

    Args:
        paths: Header and numbers.
        shape: Of all rows.
        entries: Of the header.
    """
    header_path, data_path = paths
    with raw_rows(data_path, b"", shape, np.dtype("<f4")) as add:
        yield add
        with write_errors_as(header_path):
            header_path.unlink(missing_ok=True)
    write_file(header_path, header_bytes(entries))


def header_bytes(values: Mapping[str, HeaderValue]) -> bytes:
    """The header with these entries, in their order; numbers with all their digits.

    >>> print(header_bytes({"lines": 2, "wavelength": [450.0, 550.5], "band names": ["a,b", "c"]}).decode())
    ENVI
    lines = 2
    wavelength = { 450.0, 550.5 }
    band names = { a-b, c }
    """
    lines = ["ENVI", *(f"{key} = {_text(key, value)}" for key, value in values.items()), ""]
    return "\n".join(lines).encode()


def layout_entries(samples: int, lines: int, bands: int, interleave: str) -> dict[str, HeaderValue]:
    """How the numbers lie on disk; float32, little-endian, nothing before them."""
    return {
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "header offset": 0,
        "data type": _FLOAT32,
        "interleave": interleave,
        "byte order": 0,
    }


def wavelength_entries(bands: Bands) -> dict[str, HeaderValue]:
    """Band centres and widths in nm; a width is that of the band's interval, an estimate from the spacing."""
    widths = bands.widths_nm.round(6)
    return {"wavelength units": "Nanometers", "wavelength": bands.centers_nm, "fwhm": widths}


def beside(path_without_suffix: Path, suffix: str) -> Path:
    """A file with this suffix; dots in the name before it stay."""
    return path_without_suffix.with_name(path_without_suffix.name + suffix)


def _text(key: str, value: HeaderValue) -> str:
    if isinstance(value, str):
        return "{ " + _plain(value) + " }" if key == "description" else _plain(value)
    if isinstance(value, int):
        return str(value)
    return "{ " + ", ".join(map(_element, value)) + " }"


def _element(value: str | float) -> str:
    return _plain(value).replace(",", "-") if isinstance(value, str) else repr(float(value))


def _plain(text: str) -> str:
    """One line without braces."""
    return re.sub(r"\s+", " ", text.replace("{", "(").replace("}", ")")).strip()
