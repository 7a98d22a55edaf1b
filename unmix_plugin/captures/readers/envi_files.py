"""The two files of an ENVI image: a header, and the numbers beside it."""

from __future__ import annotations

import re
from pathlib import Path

from unmix_plugin.errors import CaptureError
from unmix_plugin.spectral.library.envi_text import parse_envi_header

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
