"""ENVI images: numbers as they lie in memory, which a text beside them describes."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from unmix_plugin.captures.spectral_file import (
    BandIndex,
    ReadOptions,
    SpectralFile,
    take_part,
)
from unmix_plugin.captures.wavelengths import StatedBands, check_bands
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.envi import EnviLayout, data_beside, header_items, read_header, read_layout

_SHOWN_LENGTH = 200
"""Longer entries of a header are lists, which are not kept as metadata."""
_COMPRESSED = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"PK\x03\x04": "zip", b"\xfd7zXZ": "xz"}


def is_envi_header(path: Path) -> bool:
    """Whether a file of any name begins as a header does."""
    with path.open("rb") as file:
        begin = file.read(16).removeprefix(b"\xef\xbb\xbf")
    return re.match(rb"ENVI\s", begin) is not None


def header_beside(data_path: Path) -> Path | None:
    """The ENVI header of a file of numbers: x.hdr or x.raw.hdr for x.raw."""
    for candidate in (data_path.with_name(data_path.name + ".hdr"), data_path.with_suffix(".hdr")):
        for path in (candidate, candidate.with_suffix(".HDR")):
            if path.is_file() and path != data_path:
                return path
    return None


def open_envi(path: Path, _: ReadOptions) -> SpectralFile:
    """Open an image by its header, or by the file of numbers beside it."""
    is_header = path.suffix.lower() == ".hdr" or is_envi_header(path)
    header_path = path if is_header else header_beside(path)
    if header_path is None:
        raise CaptureError(f"{path}: no header beside this file; expected {path.stem}.hdr or {path.name}.hdr")
    try:
        header = read_header(header_path)
        layout = read_layout(header)
        data_path = path if path != header_path else data_beside(header_path, layout.num_bytes)
    except ValueError as error:
        raise CaptureError(f"{header_path}: {error}") from error
    stated = StatedBands(
        "header field 'wavelength'",
        header_items(header, "wavelength") or None,
        header.get("wavelength units"),
        header_items(header, "fwhm") or None,
        header_items(header, "bbl") or None,
        header_items(header, "band names", ",") or None,
    )
    size_notes = _check_size(header_path, data_path, layout)
    bands, band_notes = check_bands(stated, layout.shape[2])
    key, scale_notes = "reflectance scale factor", ()
    scale = _number(header, key)
    if key in header and (scale is None or not math.isfinite(scale) or scale <= 0):
        scale_notes = (f"'{key}' is {header[key]} and is left out; expected a number above 0",)
        scale = None
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
    shape = tuple(lengths[axis] for axis in layout.axes)
    stored = np.memmap(data_path, layout.dtype, "r", layout.offset, shape)
    return take_part(stored, layout.axes, rows, bands)


def _check_size(header_path: Path, data_path: Path, layout: EnviLayout) -> tuple[str, ...]:
    """A note if there is more than the header describes; less, or compressed numbers, are refused."""
    found, needed = data_path.stat().st_size, layout.num_bytes
    if found >= needed:
        return (f"{found - needed} bytes more than the header describes",) if found > needed else ()
    with data_path.open("rb") as file:
        begin = file.read(6)
    kind = next((kind for magic, kind in _COMPRESSED.items() if begin.startswith(magic)), None)
    if kind is not None:
        raise CaptureError(f"{data_path}: compressed with {kind}; unpack it, as numbers are read in place")
    height, width, num_bands = layout.shape
    raise CaptureError(
        f"{data_path}: cut short: {found} bytes; {header_path.name} promises {needed} ({height} lines x {width} "
        f"samples x {num_bands} bands of {layout.dtype.name} after {layout.offset} bytes). Copy the file again or "
        "correct the header"
    )


def _number(header: dict[str, str], key: str) -> float | None:
    try:
        return float(header[key])
    except (KeyError, ValueError):
        return None
