"""ENVI images: a header of text, and numbers as they lie in memory.

Notation: `H` lines, `W` samples, `B` bands.
"""

from __future__ import annotations

import re
from math import isfinite
from pathlib import Path

import numpy as np

from unmix_plugin.captures.readers.envi_files import (
    data_beside,
    header_beside,
    is_envi_header,
    read_envi_header,
)
from unmix_plugin.captures.readers.envi_layout import EnviLayout, read_layout
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.readers.stated_bands import StatedBands, check_bands
from unmix_plugin.captures.spectral_file import BandIndex, SpectralFile
from unmix_plugin.errors import CaptureError

_SHOWN_LENGTH = 200
"""Longer entries of a header are lists, which are not kept as metadata."""
_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"PK\x03\x04": "zip", b"\xfd7zXZ": "xz"}


def open_envi(path: Path, _: ReadOptions) -> SpectralFile:
    """Open an image by its header, or by the file of numbers beside it.

    Raises:
        CaptureError: a file is missing, is of another kind, or holds less than the header promises.
    """
    is_header = path.suffix.lower() == ".hdr" or is_envi_header(path)
    header_path = path if is_header else header_beside(path)
    if header_path is None:
        raise CaptureError(f"{path}: no header beside this file; expected {path.stem}.hdr or {path.name}.hdr")
    header = read_envi_header(header_path)
    try:
        layout = read_layout(header)
    except ValueError as error:
        raise CaptureError(f"{header_path}: {error}") from error
    data_path = path if path != header_path else data_beside(header_path, layout.num_bytes)
    size_notes = _check_size(header_path, data_path, layout)
    bands, band_notes = check_bands(_stated_bands(header), layout.shape[2])
    scale, scale_notes = _scale(header)
    return SpectralFile(
        path=header_path,
        reader="envi",
        shape=layout.shape,
        dtype=layout.dtype,
        read_part=lambda rows, wanted: _read_part(data_path, layout, rows, wanted),
        bands=bands,
        interleave=layout.interleave,
        scale=scale,
        no_data=_number(header, "data ignore value"),
        notes=layout.notes + size_notes + band_notes + scale_notes,
        metadata={"header": {key: value for key, value in header.items() if len(value) < _SHOWN_LENGTH}},
        sources=(data_path,),
    )


def _read_part(data_path: Path, layout: EnviLayout, rows: slice, bands: BandIndex) -> np.ndarray:
    """Map, copy and let go, so that many files can be open at a time."""
    found = data_path.stat().st_size
    if found < layout.num_bytes:  # touching a map beyond the end of its file would end the process
        raise CaptureError(f"{data_path}: {found} bytes are left of {layout.num_bytes}; the file was cut")
    lengths = dict(zip("yxb", layout.shape, strict=True))
    stored = np.memmap(
        data_path, layout.dtype, "r", layout.offset, tuple(lengths[axis] for axis in layout.axes)
    )
    return np.array(
        stored.transpose([layout.axes.index(axis) for axis in "yxb"])[rows][:, :, bands], order="C"
    )


def _check_size(header_path: Path, data_path: Path, layout: EnviLayout) -> tuple[str, ...]:
    """A note if there is more than the header describes.

    Raises:
        CaptureError: there is less, or the numbers are compressed.
    """
    found, needed = data_path.stat().st_size, layout.num_bytes
    with data_path.open("rb") as file:
        begin = file.read(6)
    kind = next((kind for magic, kind in _COMPRESSED.items() if begin.startswith(magic)), None)
    height, width, num_bands = layout.shape
    what = f"{height} lines x {width} samples x {num_bands} bands of {layout.dtype.name}"
    if found < needed:
        if kind is not None:
            raise CaptureError(
                f"{data_path}: compressed with {kind}; unpack it, as numbers are read in place"
            )
        raise CaptureError(
            f"{data_path}: cut short: {found} bytes; {header_path.name} promises {needed} ({what} after "
            f"{layout.offset} bytes). Copy the file again or correct the header"
        )
    return (f"{found - needed} bytes more than the header describes",) if found > needed else ()


def _stated_bands(header: dict[str, str]) -> StatedBands:
    return StatedBands(
        "header field 'wavelength'",
        _items(header, "wavelength"),
        header.get("wavelength units"),
        _items(header, "fwhm"),
        _items(header, "bbl"),
        _items(header, "band names", ","),
    )


def _items(header: dict[str, str], key: str, separator: str = r"[,\s]") -> list[str] | None:
    """Elements of a list; commas too many at its ends or in a row count as none."""
    items = [" ".join(item.split()) for item in re.split(separator, header.get(key, ""))]
    items = [item for item in items if item]
    return items or None


def _number(header: dict[str, str], key: str) -> float | None:
    try:
        return float(header[key])
    except (KeyError, ValueError):
        return None


def _scale(header: dict[str, str]) -> tuple[float | None, tuple[str, ...]]:
    key = "reflectance scale factor"
    scale = _number(header, key)
    if scale is not None and isfinite(scale) and scale > 0:
        return scale, ()
    return None, (
        (f"'{key}' is {header[key]} and is left out; expected a number above 0",) if key in header else ()
    )
