"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin.

Little-endian; every count is checked before it is used.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.poses.colmap_lens import MODELS
from unmix_plugin.captures.poses.colmap_model import ColmapCamera, ColmapImage
from unmix_plugin.captures.poses.raw_poses import SparsePoints
from unmix_plugin.errors import CaptureError

_CAMERA, _IMAGE, _POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_LONGEST_NAME = 4096


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Cameras by their number.

    Raises:
        CaptureError: the file is cut short, or a camera is of an unknown model.
    """
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.count(_CAMERA.size, "cameras")):
        number, model, width, height = reader.take(_CAMERA)
        if model not in MODELS:
            raise CaptureError(
                f"{path}: a camera has the model number {model}; COLMAP's are {min(MODELS)} to {max(MODELS)}: "
                "the file is damaged, or no file of COLMAP"
            )
        name, length = MODELS[model]
        cameras[number] = ColmapCamera(name, width, height, reader.take(struct.Struct(f"<{length}d")))
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    """Images with their poses; where points were seen is passed over.

    Raises:
        CaptureError: the file is cut short.
    """
    reader = _Reader(path)
    images = []
    for _ in range(reader.count(_IMAGE.size + 9, "images")):
        _, *numbers, camera = reader.take(_IMAGE)
        name = reader.text()
        reader.skip(reader.count(_OBSERVATION_BYTES, f"observations in {name}") * _OBSERVATION_BYTES)
        images.append(ColmapImage(name, camera, tuple(numbers[:4]), tuple(numbers[4:])))
    return images


def read_points(path: Path) -> SparsePoints:
    """Sparse points with their colours.

    Raises:
        CaptureError: the file is cut short.
    """
    reader = _Reader(path)
    count = reader.count(_POINT.size, "points")
    positions, colours = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for index in range(count):
        _, x, y, z, red, green, blue, _, length = reader.take(_POINT)
        positions[index], colours[index] = (x, y, z), (red, green, blue)
        reader.skip(length * _TRACK_BYTES)
    return SparsePoints(positions, colours)


class _Reader:
    """Bytes of a file from front to back."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
        self._at = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Numbers of the layout."""
        start = self._at
        self.skip(layout.size)
        return layout.unpack_from(self._data, start)

    def skip(self, count: int) -> None:
        """Pass over bytes."""
        left = len(self._data) - self._at
        if count > left:
            raise CaptureError(
                f"{self._path} ends early: {left} bytes are left where {count} are expected; copy it again"
            )
        self._at += count

    def count(self, least_bytes: int, what: str) -> int:
        """A number of records, each of at least so many bytes."""
        (count,) = self.take(struct.Struct("<Q"))
        left = len(self._data) - self._at
        if count * least_bytes > left:
            raise CaptureError(
                f"{self._path} promises {count} {what}, but only {left} bytes follow; it is damaged or no file of "
                "COLMAP: copy it again"
            )
        return count

    def text(self) -> str:
        """Characters up to a zero."""
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)
        if end < 0:
            raise CaptureError(f"{self._path}: the name of an image has no end; it is damaged: copy it again")
        text = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return text
