"""What kind of file something is, by its first bytes and then by its name."""

from __future__ import annotations

import zipfile
from pathlib import Path

from unmix_plugin.captures.readers.envi_files import header_beside, is_envi_header
from unmix_plugin.errors import CaptureError

_BEGINNINGS = {
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"II+\0": "tiff",
    b"MM\0+": "tiff",
    b"v/1\x01": "exr",
    b"\x93NUMPY": "npy",
    b"MATLAB 5.0": "matlab",
    b"MATLAB 7.3": "hdf5",
    b"\x89HDF\r\n\x1a\n": "hdf5",
    b"CDF": "netcdf",
    b"\x89PNG\r\n\x1a\n": "picture",
    b"\xff\xd8\xff": "picture",
}
_SUFFIXES = {".hdr": "envi", ".pt": "torch", ".pth": "torch"}
"""Kinds that their first bytes don't tell, or that are refused with a better reason by their reader."""
_LFS_POINTER = b"version https://git-lfs"
_REFUSED = {
    b"\x1f\x8b": "compressed with gzip; unpack it first",
    b"BZh": "compressed with bzip2; unpack it first",
    b"\xfd7zXZ": "compressed with xz; unpack it first",
    b"Rar!": "a RAR archive; unpack it first",
    b"7z\xbc\xaf": "a 7z archive; unpack it first",
    b"<!DOCTYPE": "a web page, perhaps in place of a download; download the file again",
    b"<html": "a web page, perhaps in place of a download; download the file again",
    b"#?RADIANCE": "a Radiance picture, which holds no spectral bands",
}
_KNOWN = "ENVI, TIFF, OpenEXR, MATLAB, HDF5, NetCDF, .npy, .npz, .pt, PNG, JPEG, or a folder with one picture a band"
_HDF5_STARTS = (512, 1024, 2048, 4096)
"""Where the mark of HDF5 may follow bytes of another program."""


def file_kind(path: Path) -> str:
    """Name of the reader for a file or folder.

    Raises:
        CaptureError: it is missing, empty, or of a kind that no reader reads.
    """
    if path.is_dir():
        return "folder"
    if not path.is_file():
        raise CaptureError(f"{path}: no such file")
    with path.open("rb") as file:
        begin = file.read(4096 + 8)
    if not begin:
        raise CaptureError(f"{path}: the file is empty; copy it again")
    if begin.startswith(_LFS_POINTER):
        raise CaptureError(f"{path}: a pointer of Git LFS, not the file itself; fetch it with 'git lfs pull'")
    kind = _by_content(path, begin)
    if kind is None:
        raise CaptureError(
            f"{path}: of no known kind: begins with {begin[:8]!r}, has no ENVI header beside it; expected {_KNOWN}"
        )
    return kind


def _by_content(path: Path, begin: bytes) -> str | None:
    kind = next((kind for magic, kind in _BEGINNINGS.items() if begin.startswith(magic)), None)
    if kind is not None:
        return kind
    if any(begin[start : start + 8] == b"\x89HDF\r\n\x1a\n" for start in _HDF5_STARTS):
        return "hdf5"
    if begin.startswith(b"PK\x03\x04") and zipfile.is_zipfile(path):
        return _kind_of_zip(path)
    if is_envi_header(path) or (path.suffix.lower() != ".hdr" and header_beside(path) is not None):
        return "envi"
    refused = next((why for magic, why in _REFUSED.items() if begin.lstrip().startswith(magic)), None)
    if refused is not None:
        raise CaptureError(f"{path}: {refused}")
    return _SUFFIXES.get(path.suffix.lower())


def _kind_of_zip(path: Path) -> str:
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    if any(name.endswith("/data.pkl") for name in names):
        return "torch"
    if names and all(name.endswith(".npy") for name in names):
        return "npz"
    raise CaptureError(f"{path}: a zip archive ({', '.join(names[:3]) or 'empty'}); unpack it first")
