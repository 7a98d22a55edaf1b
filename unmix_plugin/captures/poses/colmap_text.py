"""COLMAP's text files: cameras.txt, images.txt, points3D.txt."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from unmix_plugin.captures.poses.colmap_lens import PARAMETER_COUNTS
from unmix_plugin.captures.poses.colmap_model import ColmapCamera, ColmapImage
from unmix_plugin.captures.poses.raw_poses import SparsePoints
from unmix_plugin.errors import CaptureError

Record = TypeVar("Record")


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Cameras by their number.

    Raises:
        CaptureError: a line is not a camera.
    """

    def parse(line: str) -> tuple[int, ColmapCamera]:
        number, model, width, height, *parameters = line.split()
        if len(parameters) != PARAMETER_COUNTS[model]:
            raise ValueError
        numbers = tuple(float(value) for value in parameters)
        return int(number), ColmapCamera(model, int(width), int(height), numbers)

    expected = "number, model, width, height and the parameters of the model"
    return dict(_parse(path, number, line, parse, expected) for number, line in _lines(path) if _holds(line))


def read_images(path: Path) -> list[ColmapImage]:
    """Images with their poses; every second line, where points were seen, is passed over.

    Raises:
        CaptureError: a line is not an image.
    """

    def parse(line: str) -> ColmapImage:
        _, *numbers = line.split(maxsplit=9)
        qw, qx, qy, qz, x, y, z = (float(value) for value in numbers[:7])
        return ColmapImage(numbers[8].strip(), int(numbers[7]), (qw, qx, qy, qz), (x, y, z))

    images = []
    lines = iter(_lines(path))
    for number, line in lines:
        if _holds(line):
            expected = "number, quaternion, translation, camera and name"
            images.append(_parse(path, number, line, parse, expected))
            next(lines, None)
    return images


def read_points(path: Path) -> SparsePoints:
    """Sparse points with their colours.

    Raises:
        CaptureError: a line is not a point.
    """

    def parse(line: str) -> tuple[list[float], list[int]]:
        _, x, y, z, red, green, blue, *_ = line.split()
        colours = [int(red), int(green), int(blue)]
        if not all(0 <= value <= 255 for value in colours):
            raise ValueError
        return [float(x), float(y), float(z)], colours

    expected = "number, x, y, z, red, green, blue"
    found = [_parse(path, number, line, parse, expected) for number, line in _lines(path) if _holds(line)]
    positions = np.array([point for point, _ in found], dtype=np.float64).reshape(-1, 3)
    return SparsePoints(positions, np.array([colour for _, colour in found], dtype=np.uint8).reshape(-1, 3))


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        text = path.read_text("utf-8", "replace")
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
    return list(enumerate(text.splitlines(), start=1))


def _holds(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _parse(path: Path, number: int, line: str, parse: Callable[[str], Record], expected: str) -> Record:
    try:
        return parse(line)
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise CaptureError(
            f"{path}, line {number}: found {line.strip()[:80]!r}; expected {expected}: was the file cut short?"
        ) from error
