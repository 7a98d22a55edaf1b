"""Poses of a COLMAP model: a folder with cameras, images and points3D, as .bin or .txt.

Camera models of COLMAP as our lens: exactly where they are of its kind, otherwise the nearest one.

Cameras and images as COLMAP writes them.

COLMAP's binary files: cameras.bin, images.bin, points3D.bin.

Little-endian; every count is checked before it is used.

COLMAP's text files: cameras.txt, images.txt, points3D.txt.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.lens import Lens, Points, Project, fit_lens, project_fisheye, project_opencv
from unmix_plugin.captures.poses.pose_set import FLIP, PoseSet, RawCamera, SparsePoints, make_pose_set
from unmix_plugin.errors import CaptureError

PLACES = (".", "sparse", "colmap", "colmap/sparse", "sparse/*", "colmap/sparse/*", "colmap/*")
"""Where under a folder a model is looked for."""


def find_models(folder: Path) -> list[Path]:
    """Folders with a COLMAP model, as its programs lay them out."""
    places = [place for pattern in PLACES for place in _matching(folder, pattern)]
    return [place for place in dict.fromkeys(places) if _suffix(place) is not None]


def read_colmap(folder: Path) -> PoseSet:
    """Poses, lenses and sparse points of the model in a folder.

    Raises:
        CaptureError: a file is missing or damaged, an image names a camera that is not there, or a lens can't be
            represented.
    """
    suffix = _suffix(folder)
    if suffix is None:
        raise CaptureError(
            f"{folder} has no COLMAP model; expected cameras and images as .bin or .txt: give the folder that has both"
        )
    is_binary = suffix == "bin"
    cameras = (read_binary_cameras if is_binary else read_text_cameras)(folder / f"cameras.{suffix}")
    images = (read_binary_images if is_binary else read_text_images)(folder / f"images.{suffix}")
    points_path = folder / f"points3D.{suffix}"
    read_points = read_binary_points if is_binary else read_text_points
    points = read_points(points_path) if points_path.is_file() else None
    notes = [] if points is not None else [f"{points_path.name} is not there: no sparse points"]
    lenses = _lenses({image.camera for image in images}, cameras, folder / f"cameras.{suffix}", notes)
    where = str(folder / f"images.{suffix}")
    raw = [RawCamera(image.name, _matrix(image, where), lenses[image.camera]) for image in images]
    return make_pose_set(raw, f"COLMAP model in {folder}", where, points, None, notes)


def _lenses(
    used: set[int], cameras: dict[int, ColmapCamera], path: Path, notes: list[str]
) -> dict[int, Lens]:
    lenses = {}
    for number in sorted(used):
        if number not in cameras:
            raise CaptureError(
                f"{path} has no camera {number}, which images name; the files do not belong together"
            )
        camera = cameras[number]
        if not np.isfinite(camera.parameters).all() or not (
            0 < camera.width < 1e6 and 0 < camera.height < 1e6
        ):
            raise CaptureError(
                f"{path}: camera {number} is {camera.width} x {camera.height} with {camera.parameters}; expected "
                "a size and finite numbers: the file is damaged"
            )
        lens, note = colmap_lens(camera.model, camera.width, camera.height, camera.parameters, str(path))
        lenses[number] = lens
        notes += [] if note is None else [note]
    return lenses


def _matrix(image: ColmapImage, where: str) -> Float64[np.ndarray, "3 4"]:
    """Camera to world, OpenGL axes."""
    quaternion = np.array(image.quaternion)
    length = float(np.linalg.norm(quaternion))
    if not 1e-6 < length < 1e6:
        raise CaptureError(
            f"{where}: {image.name} has the quaternion {image.quaternion}; expected length 1: the file is damaged"
        )
    rotation = rotation_of(quaternion / length).T
    return np.column_stack([rotation @ FLIP, -rotation @ np.array(image.translation)])


def rotation_of(quaternion: Float64[np.ndarray, "4"]) -> Float64[np.ndarray, "3 3"]:
    """Matrix of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _suffix(folder: Path) -> str | None:
    """bin or txt; a folder with both is read from bin."""
    for suffix in ("bin", "txt"):
        if all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


def _matching(folder: Path, pattern: str) -> list[Path]:
    return [folder] if pattern == "." else sorted(path for path in folder.glob(pattern) if path.is_dir())


MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters by COLMAP's number."""
PARAMETER_COUNTS = dict(MODELS.values())
_ONE_FOCAL = {
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
}
_FISHEYES = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"}
_EXACT = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}


def colmap_lens(
    model: str, width: int, height: int, parameters: tuple[float, ...], where: str
) -> tuple[Lens, str | None]:
    """Our lens for a camera of COLMAP, and a note if it is not exactly the same.

    Raises:
        CaptureError: the model can't be represented, or focal length or centre make no sense.
    """
    if model not in _EXACT | _FISHEYES | {"FULL_OPENCV"}:
        known = ", ".join(sorted(_EXACT | _FISHEYES | {"FULL_OPENCV"}))
        raise CaptureError(
            f"{where}: the camera model {model} is not supported; expected one of {known}: run COLMAP's "
            "image_undistorter and give its model and images"
        )
    single = model in _ONE_FOCAL
    focal = (parameters[0], parameters[0]) if single else (parameters[0], parameters[1])
    rest = parameters[1:] if single else parameters[2:]
    center, terms = (rest[0], rest[1]), rest[2:]
    if min(focal) <= 0:
        raise CaptureError(
            f"{where}: a camera has the focal length {min(focal):g}; expected pixels above 0: run COLMAP again"
        )
    if model in _EXACT:
        k1, k2, p1, p2 = (*terms, *([0.0] * (4 - len(terms))))
        return Lens(width, height, focal, center, (k1, k2, p1, p2)), None
    start = Lens(width, height, focal, center)
    if model == "FULL_OPENCV":
        if not any(terms[5:]):
            k1, k2, p1, p2, k3 = terms[:5]
            return Lens(width, height, focal, center, (k1, k2, p1, p2), (k3, 0.0)), None
        return fit_lens(_full_opencv(focal, center, terms), start, model, where)
    return fit_lens(lambda ideal: project_fisheye(ideal, focal, center, terms), start, model, where)


def _full_opencv(
    focal: tuple[float, float], center: tuple[float, float], terms: tuple[float, ...]
) -> Project:
    k1, k2, p1, p2, k3, *below = terms

    def project(ideal: Points) -> Points:
        squared = (ideal**2).sum(axis=1, keepdims=True)
        origin = (0.0, 0.0)
        bent = project_opencv(ideal, (1.0, 1.0), origin, (k1, k2, k3))
        slanted = project_opencv(ideal, (1.0, 1.0), origin, (), (p1, p2)) - ideal
        divisor = 1.0 + sum(k * squared ** (power + 1) for power, k in enumerate(below))
        return (bent / divisor + slanted) * focal + center

    return project


@dataclass(frozen=True)
class ColmapCamera:
    """A lens."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]
    """As the model orders them."""


@dataclass(frozen=True)
class ColmapImage:
    """A posed image."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    """w, x, y, z of the rotation from world to camera."""
    translation: tuple[float, ...]
    """From world to camera."""


_CAMERA, _IMAGE, _POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_LONGEST_NAME = 4096


def read_binary_cameras(path: Path) -> dict[int, ColmapCamera]:
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


def read_binary_images(path: Path) -> list[ColmapImage]:
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


def read_binary_points(path: Path) -> SparsePoints:
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


Record = TypeVar("Record")


def read_text_cameras(path: Path) -> dict[int, ColmapCamera]:
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


def read_text_images(path: Path) -> list[ColmapImage]:
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


def read_text_points(path: Path) -> SparsePoints:
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
