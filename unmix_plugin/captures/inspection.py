"""What files of instruments and of pose programs hold, as plain values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

_LARGEST_PROOF = 2**28
"""Bytes of a row that is read as a proof; of larger ones a single band, or nothing."""
_LONGEST_TEXT = 500
_LLFF_COLUMNS = 17
_POSE_SUFFIXES = (".json", ".xml", ".bin", ".txt")
FACTS = (
    *(
        "reader",
        "shape",
        "dtype",
        "interleave",
        "wavelengths_nm",
        "wavelength_evidence",
        "fwhm_nm",
        "band_names",
    ),
    *("bad_bands", "scale", "no_data", "poses", "notes", "metadata"),
)
"""What is reported of every file, None where it has no such thing."""


def inspect_file(path: Path, options: ReadOptions | None = None) -> dict[str, Any]:
    """Facts about a file or folder, as JSON-able values: an image, poses, or both.

    The last row of an image is read, so that a file that is cut short is found out.

    Raises:
        CaptureError: the file is neither, or is damaged.
    """
    try:
        opened = open_spectral_file(path, options)
        _prove(opened)
    except CaptureError as error:
        poses = _poses_of(path, error)
        return {"file": str(path), **dict.fromkeys(FACTS), **poses}
    facts = describe(opened)
    if path.suffix.lower() == ".npy" and opened.shape[1:] == (_LLFF_COLUMNS, 1):
        facts |= _poses_of(path, None)
    return {"file": str(path), **facts}


def describe(opened: SpectralFile) -> dict[str, Any]:
    """What an opened image says of itself; indices of bands count from 0."""
    bands = opened.bands
    return {
        "reader": opened.reader,
        "shape": list(opened.shape),
        "dtype": opened.dtype.newbyteorder("=").name,
        "interleave": opened.interleave,
        "wavelengths_nm": _listed(bands.wavelengths_nm),
        "wavelength_evidence": bands.evidence,
        "fwhm_nm": _listed(bands.fwhm_nm),
        "band_names": None if bands.names is None else list(bands.names),
        "bad_bands": None if bands.bad is None else np.flatnonzero(bands.bad).tolist(),
        "scale": _number(opened.scale),
        "no_data": _number(opened.no_data),
        "poses": None,
        "notes": list(opened.notes),
        "metadata": _plain(opened.metadata),
    }


def _prove(opened: SpectralFile) -> None:
    """Read the last row, or one band of it."""
    height, width, num_bands = opened.shape
    row_bytes = width * opened.dtype.itemsize
    if row_bytes <= _LARGEST_PROOF:
        first = 0 if row_bytes * num_bands <= _LARGEST_PROOF else num_bands - 1
        opened.read(slice(height - 1, height), slice(first, num_bands))


def _poses_of(path: Path, refused: CaptureError | None) -> dict[str, Any]:
    """Number of cameras and notes of a file of poses.

    Raises:
        CaptureError: it holds none, and is not an image either: the more fitting of both reasons.
    """
    from unmix_plugin.captures.poses.reading import read_poses

    try:
        found = read_poses(path)
    except CaptureError as error:
        if refused is None:
            return {}
        raise (error if path.suffix.lower() in _POSE_SUFFIXES else refused) from error
    return {"poses": len(found.cameras), "notes": list(found.notes), "metadata": {"source": found.source}}


def _listed(values: np.ndarray | None) -> list[float] | None:
    return None if values is None else [round(value, 6) for value in values.tolist()]


def _number(value: float | None) -> float | str | None:
    """JSON has no word for numbers that are not finite."""
    return value if value is None or math.isfinite(value) else str(value)


def _plain(value: Any) -> Any:
    """JSON-able, with long texts cut."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return _number(value)
    if value is None or isinstance(value, bool | int):
        return value
    text = str(value)
    return text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
