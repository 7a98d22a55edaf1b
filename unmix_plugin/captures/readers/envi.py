"""ENVI images: a header of text, and numbers as they lie in memory."""

from __future__ import annotations

import re
from math import isfinite
from pathlib import Path

import numpy as np

from unmix_plugin.captures.spectral_file import BandIndex, ReadOptions, SpectralFile
from unmix_plugin.captures.wavelengths import StatedBands, check_bands
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.envi import EnviLayout, parse_envi_header, read_layout

_DATA_SUFFIXES = ("", ".img", ".dat", ".raw", ".bil", ".bip", ".bsq", ".bin", ".cube", ".hyspex", ".sli")
_LARGEST_HEADER = 2**24
_OTHER_HEADERS = {
    "#?R": "a Radiance picture",
    "BYTEORDER": "an ESRI (ArcGIS) band file",
    "NROWS": "an ESRI (ArcGIS) band file",
    "NCOLS": "an ESRI (ArcGIS) band file",
}
"""What else ends in .hdr, by how it begins."""


def read_envi_header(path: Path) -> dict[str, str]:
    """Entries of a header.

    Raises:
        CaptureError: it is no ENVI header.
    """
    size = path.stat().st_size
    if size > _LARGEST_HEADER:
        raise CaptureError(f"{path}: no ENVI header: {size} bytes; expected a text of a few kB")
    data = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    try:
        return parse_envi_header(text)
    except ValueError as error:
        begin = text.lstrip().upper()
        other = next((kind for word, kind in _OTHER_HEADERS.items() if begin.startswith(word)), None)
        found = f"it is the header of {other}" if other else str(error)
        raise CaptureError(
            f"{path}: no ENVI header: {found}; expected 'ENVI' and then 'key = value' lines. "
            "Convert the file to ENVI or write such a header for it"
        ) from error


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


def data_beside(header_path: Path, needed_bytes: int) -> Path:
    """The file of numbers that a header describes; of several the first that is large enough.

    Raises:
        CaptureError: there is none.
    """
    base = header_path.with_suffix("")
    names = [base.name + suffix for suffix in _DATA_SUFFIXES]
    names = [either for name in names for either in (name, _upper_suffix(name))]
    candidates = dict.fromkeys(base.with_name(name) for name in names)
    found = [path for path in candidates if path.is_file() and path != header_path]
    if not found:
        raise CaptureError(
            f"{header_path}: no file of numbers beside this header; expected {base.name} or {base.name}.img "
            "(.dat, .raw, .bil, .bip, .bsq, ...) in the same folder"
        )
    return next((path for path in found if path.stat().st_size >= needed_bytes), found[0])


def _upper_suffix(name: str) -> str:
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}{dot}{suffix.upper()}" if dot else name


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
