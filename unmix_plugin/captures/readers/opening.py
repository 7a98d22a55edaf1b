"""Any file of an instrument: which kind it is, by its first bytes and then by its name; opened by the reader of that
kind, which reads headers only; and what it says of itself, as plain values.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.cube import (
    Cube,
    ReadOptions,
    unreadable,
    with_mask,
)
from unmix_plugin.captures.readers.band_files import open_band_folder
from unmix_plugin.captures.readers.containers import KINDS, open_container, open_hdf5
from unmix_plugin.captures.readers.derived import said_of_mosaic, take_apart
from unmix_plugin.captures.readers.envi import (
    described_by_header,
    described_image,
    open_envi,
)
from unmix_plugin.captures.readers.exr import open_exr
from unmix_plugin.captures.readers.gdal import with_xml_beside
from unmix_plugin.captures.readers.pictures import open_picture
from unmix_plugin.captures.readers.tiff import open_tiff
from unmix_plugin.captures.report import Code, Kind, Remark, sentences
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.envi import header_beside, is_envi_header
from unmix_plugin.limits import open_regular, open_zip

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
_SUFFIXES = {".hdr": "envi"}
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
_KNOWN = (
    "ENVI, TIFF, OpenEXR, MATLAB, HDF5, NetCDF, .npy, .npz, PNG, JPEG, or a folder with one picture a band"
)
_OF_TORCH = "tensors of PyTorch, which are not read; save them as .npy: numpy.save(name, tensor.numpy())"
_HDF5_STARTS = (512, 1024, 2048, 4096)
"""Where the mark of HDF5 may follow bytes of another program."""
_LARGEST_PROOF = 2**28
"""Bytes of a row that is read as a proof; of larger ones a single band, or nothing."""
_LONGEST_TEXT = 500
_OF_ARRAYS = ("npy", "matlab", "hdf5", "netcdf")
_USED_BY = {"dataset": (*_OF_ARRAYS, "exr"), "axes": (*_OF_ARRAYS, "tiff"), "size": _OF_ARRAYS}
"""Options that change nothing in files of other readers."""
_FACTS = (
    *("file", "reader", "shape", "dtype", "interleave", "wavelengths_nm", "wavelength_evidence", "fwhm_nm"),
    *("band_names", "bad_bands", "scale", "gains", "offsets", "no_data", "poses", "notes", "metadata"),
)
_LLFF_COLUMNS = 17
_POSE_SUFFIXES = (".json", ".xml", ".bin", ".txt")


def open_spectral_file(path: Path, options: ReadOptions | None = None) -> Cube:
    """Open a file, or a folder that holds one picture a band, without reading its numbers.

    Args:
        path: For ENVI the header or the file of numbers.
        options: What the user gives, which overrides the file.
    Raises:
        CaptureError: the file is missing, damaged or of no known kind, or the options don't fit it.
    """
    options = options or ReadOptions()
    try:
        opened = _opened(path, options)
        if options.mosaic is not None:
            opened = take_apart(opened, options.mosaic)
        height, width, num_bands = opened.shape
        size = f"{height} rows x {width} columns x {num_bands} bands"
        if 0 in opened.shape:
            raise CaptureError(f"{path}: the image has no pixels: {size}")
        if opened.dtype.kind not in "iuf":
            raise CaptureError(f"{path}: the image holds {opened.dtype.name}; expected real numbers")
        unused = [
            Remark.of(Code.OPTION_UNUSED, option=name, reader=opened.reader)
            for name, readers in _USED_BY.items()
            if opened.reader not in readers and getattr(options, name) is not None
        ]
        opened = opened.remarking(*unused)
        given = options.bands
        if given is None:
            return opened
        if given.num_known != num_bands:
            raise CaptureError(
                f"{opened.path}: {given.num_known} wavelengths were given for {size}{said_of_mosaic(opened)}"
            )
        known = opened.bands if given.fwhm_nm is None else replace(opened.bands, fwhm_nm=given.fwhm_nm)
        known = replace(known, wavelengths_nm=given.wavelengths_nm, source=given.source, is_given=True)
        return replace(opened, bands=known.marking(given.bad))
    except CaptureError:
        raise
    except Exception as error:
        raise unreadable(path, error) from error


def _opened(path: Path, options: ReadOptions) -> Cube:
    """The file by its reader, with what lies beside it: an ENVI header, an XML of GDAL or EnMAP, a mask of GDAL."""
    kind = _file_kind(path)
    described = described_image(path) if kind == "envi" and path.suffix.lower() == ".hdr" else None
    if described is not None:
        path, kind = described, _file_kind(described)
    opened = _READERS[kind](path, options)
    if kind == "folder":
        return opened
    opened = with_xml_beside(opened if kind == "envi" else described_by_header(opened))
    # GDAL's mask NAME.msk, of one band or as many as the file. Source: GDAL, RFC 15: band masks.
    height, width, num_bands = opened.shape
    for mask_path in [path.with_name(f"{path.name}.msk") for path in opened.files]:
        if not mask_path.is_file():
            continue
        mask = _READERS[_file_kind(mask_path)](mask_path, ReadOptions())
        if mask.shape not in {(height + opened.dark_lines, width, bands) for bands in (1, num_bands)}:
            size = " x ".join(map(str, mask.shape))
            opened = opened.remarking(Remark.of(Code.MASK_OF_OTHER_SIZE, mask=mask_path.name, size=size))
        elif mask.numbers is not None:
            opened = replace(opened, sources=(*opened.sources, mask_path))
            opened = with_mask(opened, mask_path.name, mask.numbers)
    return opened


def _file_kind(path: Path) -> str:
    """Name of the reader for a file or folder."""
    if path.is_dir():
        return "folder"
    if not path.is_file():
        raise CaptureError(f"{path}: no such file")
    with open_regular(path) as file:
        begin = file.read(4096 + 8)
    if not begin:
        raise CaptureError(f"{path}: the file is empty; copy it again")
    if begin.startswith(_LFS_POINTER):
        raise CaptureError(f"{path}: a pointer of Git LFS, not the file itself; fetch it with 'git lfs pull'")
    kind = next((kind for magic, kind in _BEGINNINGS.items() if begin.startswith(magic)), None)
    if kind is not None:
        return kind
    if any(begin[start : start + 8] == b"\x89HDF\r\n\x1a\n" for start in _HDF5_STARTS):
        return "hdf5"
    if begin.startswith(b"PK\x03\x04") and zipfile.is_zipfile(path):
        return _kind_of_archive(path)
    suffix = path.suffix.lower()
    if is_envi_header(path) or (suffix != ".hdr" and header_beside(path) is not None):
        return "envi"
    refused = next((why for magic, why in _REFUSED.items() if begin.lstrip().startswith(magic)), None)
    if refused is not None or suffix in (".pt", ".pth"):
        raise CaptureError(f"{path}: {refused or _OF_TORCH}")
    if suffix not in _SUFFIXES:
        raise CaptureError(f"{path}: of no known kind: begins with {begin[:8]!r}; expected {_KNOWN}")
    return _SUFFIXES[suffix]


def _kind_of_archive(path: Path) -> str:
    """`npz`; others are refused. Raises CaptureError."""
    with open_zip(path, CaptureError) as archive:
        names = archive.namelist()
    if any(name.endswith("/data.pkl") for name in names):
        raise CaptureError(f"{path}: {_OF_TORCH}")
    if not names or not all(name.endswith(".npy") for name in names):
        raise CaptureError(f"{path}: a zip archive ({', '.join(names[:3]) or 'empty'}); unpack it first")
    return "npz"


def inspect_file(path: Path, options: ReadOptions | None = None) -> dict[str, Any]:
    """Facts about a file or folder, as JSON-able values: an image, poses, or both.

    The same facts of every file, None where it has no such thing; indices of bands count from 0. The last row of an
    image is read, so that a file that is cut short is found out. Raises CaptureError: the file is neither, or is
    damaged.
    """
    from unmix_plugin.captures.poses.reading import read_poses

    opened = refused = None
    try:
        opened = open_spectral_file(path, options)
        height, width, num_bands = opened.shape
        row_bytes = width * opened.dtype.itemsize
        if row_bytes <= _LARGEST_PROOF:
            first = 0 if row_bytes * num_bands <= _LARGEST_PROOF else num_bands - 1
            opened.read(slice(height - 1, height), slice(first, num_bands))
    except CaptureError as error:
        opened, refused = None, error
    facts = dict.fromkeys(_FACTS) | {"file": str(path)}
    if opened is not None:
        bands, linear = opened.bands, opened.linear
        facts |= {
            "reader": opened.reader,
            "shape": list(opened.shape),
            "dtype": opened.dtype.newbyteorder("=").name,
            "interleave": opened.interleave,
            "wavelengths_nm": _listed(bands.wavelengths_nm),
            "wavelength_evidence": bands.source,
            "fwhm_nm": _listed(bands.fwhm_nm),
            "band_names": bands.names and list(bands.names),
            "bad_bands": None if bands.bad is None else np.flatnonzero(bands.bad).tolist(),
            "scale": linear and linear.scale,
            "gains": linear and linear.gains.tolist(),
            "offsets": linear and linear.offsets.tolist(),
            "no_data": _plain(opened.no_data[0] if len(opened.no_data) == 1 else opened.no_data or None),
            "notes": [text for kind in (Kind.WRONG, Kind.DONE) for text in sentences(opened.remarks, kind)],
            "metadata": _plain(opened.facts),
        }
    if opened is None or (path.suffix.lower() == ".npy" and opened.shape[1:] == (_LLFF_COLUMNS, 1)):
        try:
            poses = read_poses(path)
            source = {"source": poses.source}
            facts |= {"poses": len(poses.cameras), "notes": list(poses.notes), "metadata": source}
        except CaptureError as error:
            if refused is not None:  # neither an image nor poses: the more fitting reason
                raise (error if path.suffix.lower() in _POSE_SUFFIXES else refused) from error
    return facts


def _listed(values: np.ndarray | None) -> list[float] | None:
    return None if values is None else [round(value, 6) for value in values.tolist()]


def _plain(value: Any) -> Any:
    """JSON-able, with long texts cut."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):  # JSON has no word for numbers that are not finite
        return value if math.isfinite(value) else str(value)
    if value is None or isinstance(value, bool | int):
        return value
    text = str(value)
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."


_READERS: dict[str, Callable[[Path, ReadOptions], Cube]] = {
    **{kind: partial(open_container, kind) for kind in KINDS},
    "hdf5": open_hdf5,
    "envi": open_envi,
    "tiff": open_tiff,
    "exr": open_exr,
    "picture": open_picture,
    "folder": lambda path, options: open_band_folder(path, lambda band: _opened(band, options)),
}
