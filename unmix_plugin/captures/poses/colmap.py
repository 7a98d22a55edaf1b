"""Poses of a COLMAP model: a folder with cameras, images and points3D, as .bin or .txt.

Read by ourselves: pycolmap never ends on a damaged points3D.bin, takes no model without points, and has no wheels for
ARM processors under Linux. COLMAP 4's rigs and frames are passed over, since images have their own poses. Binary files
are little-endian; every count is checked before it is used.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses import lens as models
from unmix_plugin.captures.poses.lens import Lens, distorted_lens
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    SparsePoints,
    make_pose_set,
    read_table,
)
from unmix_plugin.errors import CaptureError

_Record = TypeVar("_Record")

_PLACES = ("", "sparse/", "colmap/", "colmap/sparse/", "sparse/*/", "colmap/sparse/*/", "colmap/*/")
_PLACES += tuple("*/" * depth for depth in range(1, 7))
"""Where under a folder a model is looked for, those first where COLMAP's programs put one; hloc writes
colmap/sparse/0/models/1."""
_MODELS: dict[str, tuple[int, models.Distortion | None]] = {
    "SIMPLE_PINHOLE": (3, None),
    "PINHOLE": (4, None),
    "SIMPLE_RADIAL": (4, None),
    "RADIAL": (5, None),
    "OPENCV": (8, None),
    "OPENCV_FISHEYE": (8, models.distort_fisheye),
    "FULL_OPENCV": (12, models.distort_opencv),
    "FOV": (5, models.distort_fov),
    "SIMPLE_RADIAL_FISHEYE": (4, models.distort_fisheye),
    "RADIAL_FISHEYE": (5, models.distort_fisheye),
    "THIN_PRISM_FISHEYE": (12, models.distort_thin_prism),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, models.distort_fisheye_624),
    "SIMPLE_DIVISION": (4, models.distort_division),
    "DIVISION": (5, models.distort_division),
    "SIMPLE_FISHEYE": (3, models.distort_fisheye),
    "FISHEYE": (4, models.distort_fisheye),
    "EUCM": (6, models.distort_eucm),
    "EQUIRECTANGULAR": (2, models.distort_equirectangular),
}
"""Number of parameters, and what distorts ideal points where the lens is not of our kind, in the order of COLMAP's
numbers from 0."""
_ONE_FOCAL = {name for name in _MODELS if name.startswith("SIMPLE_")} | {"RADIAL", "RADIAL_FISHEYE"}
_CAMERA, _IMAGE, _POINT = struct.Struct("<IiQQ"), struct.Struct("<I7dI"), struct.Struct("<Q3d3BdQ")
_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_LONGEST_NAME = 4096

_Camera: TypeAlias = tuple[str, int, int, tuple[float, ...]]
"""Model, width, height, and parameters as the model orders them."""
_Image: TypeAlias = tuple[str, int, tuple[float, ...]]
"""Name, number of the camera; from world to camera a quaternion w, x, y, z and a translation."""


def find_models(folder: Path) -> list[Path]:
    """Folders with a COLMAP model: where its programs put one first, then those that lie deeper."""
    found = [path.parent for place in _PLACES for path in sorted(folder.glob(f"{place}images.*"))]
    return [place for place in dict.fromkeys(found) if is_model(place)]


def is_model(folder: Path) -> bool:
    """Whether a folder itself holds a COLMAP model; deeper ones are not looked for."""
    return _suffix(folder) is not None


def read_colmap(folder: Path) -> PoseSet:
    """Poses, lenses and sparse points of the model in a folder. Raises CaptureError: a file is missing or damaged, an
    image names a camera that is not there, or a lens can't be represented."""
    suffix = _suffix(folder)
    if suffix is None:
        raise CaptureError(
            f"{folder} has no COLMAP model; expected cameras and images as .bin or .txt: give the folder that has both"
        )
    cameras_path, images_path, points_path = (
        folder / f"{name}.{suffix}" for name in ("cameras", "images", "points3D")
    )
    readers = (_binary_cameras, _binary_images, _binary_points)
    if suffix == "txt":
        readers = (_text_cameras, _text_images, _text_points)
    read_cameras, read_images, read_points = readers
    cameras, images = read_cameras(cameras_path), read_images(images_path)
    points = read_points(points_path) if points_path.is_file() else None
    lenses = {}
    for number in sorted({number for _, number, _ in images}):
        if number not in cameras:
            raise CaptureError(
                f"{cameras_path} has no camera {number}, which images name; the files do not belong together"
            )
        lenses[number] = _lens(*cameras[number], f"{cameras_path}: camera {number}")
    posed = [
        (name, PosedCamera(_matrix(numbers, f"{images_path}: {name}"), lenses[number]))
        for name, number, numbers in images
    ]
    notes = [f"{points_path.name} is not there: no sparse points"] if points is None else []
    return make_pose_set(posed, f"COLMAP model in {folder}", str(images_path), points, None, notes)


def _suffix(folder: Path) -> str | None:
    """bin or txt; a folder with both is read from bin."""
    for suffix in ("bin", "txt"):
        if all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


@np.errstate(all="ignore")  # what is not finite is refused where all poses are looked at
def _matrix(numbers: Sequence[float], where: str) -> Float64[np.ndarray, "3 4"]:
    """Camera to world, OpenGL axes."""
    from scipy.spatial.transform import Rotation

    w, x, y, z, *translation = numbers
    if not 1e-6 < np.linalg.norm(numbers[:4]) < 1e6:
        raise CaptureError(f"{where} has the quaternion {(w, x, y, z)}; expected length 1")
    to_world = Rotation.from_quat([x, y, z, w]).as_matrix().T
    return np.column_stack([to_world @ FLIP, -to_world @ np.array(translation)])


def _lens(model: str, width: int, height: int, parameters: tuple[float, ...], where: str) -> Lens:
    """Exactly the camera's lens where it is of our kind, otherwise the one that stands for it."""
    if not np.isfinite(parameters).all() or not (0 < width < 1e6 and 0 < height < 1e6):
        raise CaptureError(f"{where} is {width} x {height} with {parameters}; expected numbers above 0")
    if model == "EQUIRECTANGULAR":
        across, down = parameters
        parameters = (across / (2 * np.pi), down / np.pi, across / 2, down / 2)
    fx, fy, cx, cy, *terms = (parameters[0], *parameters) if model in _ONE_FOCAL else parameters
    if min(fx, fy) <= 0:
        raise CaptureError(f"{where} has the focal length {min(fx, fy):g}; expected pixels above 0")
    start, distort = Lens(width, height, (fx, fy), (cx, cy)), _MODELS[model][1]
    if distort is None or (distort is models.distort_opencv and not any(terms[5:])):
        k1, k2, p1, p2, k3 = (*terms, *[0.0] * 5)[:5]
        return replace(start, distortion=(k1, k2, p1, p2), higher_radial=(k3, 0.0))
    return distorted_lens(distort, terms, start, model, where)


def _binary_cameras(path: Path) -> dict[int, _Camera]:
    reader = _Reader(path)
    cameras = {}
    for _ in range(reader.count(_CAMERA.size, "cameras")):
        number, model, width, height = reader.take(_CAMERA)
        if not 0 <= model < len(_MODELS):
            known = f"0 to {len(_MODELS) - 1}"
            raise CaptureError(f"{path}: a camera has the model number {model}; COLMAP's are {known}")
        name, (length, _) = list(_MODELS.items())[model]
        cameras[number] = name, width, height, reader.take(struct.Struct(f"<{length}d"))
    return cameras


def _binary_images(path: Path) -> list[_Image]:
    """Images with their poses; where points were seen is passed over."""
    reader = _Reader(path)
    images = []
    for _ in range(reader.count(_IMAGE.size + 9, "images")):
        _, *numbers, camera = reader.take(_IMAGE)
        name = reader.text()
        reader.skip(reader.count(_OBSERVATION_BYTES, f"observations in {name}") * _OBSERVATION_BYTES)
        images.append((name, camera, tuple(numbers)))
    return images


def _binary_points(path: Path) -> SparsePoints:
    reader = _Reader(path)
    count = reader.count(_POINT.size, "points")
    positions, colours = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for index in range(count):
        _, x, y, z, red, green, blue, _, length = reader.take(_POINT)
        positions[index], colours[index] = (x, y, z), (red, green, blue)
        reader.skip(length * _TRACK_BYTES)
    return positions, colours


class _Reader:
    """Bytes of a file from front to back."""

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._data = path, 0, read_table(path)

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        start = self._at
        self.skip(layout.size)
        return layout.unpack_from(self._data, start)

    def skip(self, count: int) -> None:
        if count > (rest := len(self._data) - self._at):
            raise CaptureError(f"{self._path} ends early: {rest} of {count} bytes are left; copy it again")
        self._at += count

    def count(self, least_bytes: int, what: str) -> int:
        """A number of records, each of at least so many bytes."""
        (count,) = self.take(struct.Struct("<Q"))
        if count * least_bytes > (rest := len(self._data) - self._at):
            raise CaptureError(f"{self._path} promises {count} {what}, {rest} bytes follow; copy it again")
        return count

    def text(self) -> str:
        """Characters up to a zero."""
        end = self._data.find(b"\0", self._at, self._at + _LONGEST_NAME)
        if end < 0:
            raise CaptureError(f"{self._path}: the name of an image has no end; copy it again")
        text = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return text


def _text_cameras(path: Path) -> dict[int, _Camera]:
    def parse(line: str) -> tuple[int, _Camera]:
        number, model, width, height, *parameters = line.split()
        if len(parameters) != _MODELS[model][0]:
            raise ValueError
        return int(number), (model, int(width), int(height), tuple(map(float, parameters)))

    return dict(_parsed(path, parse, "number, model, width, height and the parameters of the model"))


def _text_images(path: Path) -> list[_Image]:
    """Images with their poses. COLMAP writes a line of the points that were seen below every image, blank where nothing
    was; other programs leave blank ones out. So such lines are told by their form."""

    def parse(line: str) -> _Image | None:
        words = line.split()
        with suppress(ValueError):  # x, y and the number of a point, again and again
            _ = [float(word) for word in words], [int(word) for word in words[2::3]]
            if len(words) % 3 == 0:
                return None
        _, *numbers = line.split(maxsplit=9)
        return numbers[8].strip(), int(numbers[7]), tuple(map(float, numbers[:7]))

    found = _parsed(path, parse, "number, quaternion, translation, camera and name")
    return [image for image in found if image is not None]


def _text_points(path: Path) -> SparsePoints:
    def parse(line: str) -> tuple[list[float], list[int]]:
        _, x, y, z, red, green, blue, *_ = line.split()
        colours = list(bytes([int(red), int(green), int(blue)]))  # ValueError beyond 255
        return [float(x), float(y), float(z)], colours

    found = _parsed(path, parse, "number, x, y, z, red, green, blue")
    positions = np.array([point for point, _ in found], dtype=np.float64).reshape(-1, 3)
    return positions, np.array([colour for _, colour in found], dtype=np.uint8).reshape(-1, 3)


def _parsed(path: Path, parse: Callable[[str], _Record], expected: str) -> list[_Record]:
    """Records of a text file, one a line; comments and blank lines between them are nothing."""
    records = []
    for number, line in enumerate(read_table(path).decode("utf-8", "replace").splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            records.append(parse(line))
        except (ValueError, IndexError, KeyError, OverflowError) as error:
            found = line.strip()[:80]
            raise CaptureError(f"{path}, line {number}: found {found!r}; expected {expected}") from error
    return records
