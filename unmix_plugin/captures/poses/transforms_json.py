"""Poses of transforms.json: nerfstudio's, Blender's with `camera_angle_x`, bare lists, rotations with scale.

Lenses of transforms.json: keys of a frame, otherwise those of the whole file (nerfstudio's rule).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.files import PictureSizes
from unmix_plugin.captures.poses.lens import Lens, fit_lens, project_fisheye
from unmix_plugin.captures.poses.pose_set import PoseSet, RawCamera, SparsePoints, make_pose_set, name_some
from unmix_plugin.errors import CaptureError, SceneError
from unmix_plugin.formats.meshes import read_ply_points
from unmix_plugin.scenes.placement import Placement, read_placement
from unmix_plugin.scenes.reading.faults import Faults, describe, read_number

NAME_KEYS = ("file_path", "hyperspectral_file_path", "name")
"""Of a frame: the first that is there names its image."""


def read_transforms(contents: Mapping[Path, Any], sizes: PictureSizes) -> PoseSet:
    """Poses of one transforms.json, or of one for each split.

    Args:
        contents: JSON of the files.
        sizes: Of the pictures, where the files don't say.
    Raises:
        CaptureError: no list of frames, a frame without a sound pose, or a lens that can't be represented.
    """
    cameras: list[RawCamera] = []
    notes: list[str] = []
    points: SparsePoints | None = None
    up = np.array([0.0, 0.0, 1.0])
    for path, content in contents.items():
        top = content if isinstance(content, dict) else {}
        placement = _placement(path, top)
        found = _read_frames(path, content, sizes, notes)
        if not placement.is_identity:
            notes.append(f"{path.name}: applied_transform and applied_scale are undone")
        cameras += [_unplaced(camera, placement) for camera in found]
        points = points or _read_points(path, top, placement, notes)
        up = placement.rotation.T @ np.array([0.0, 0.0, 1.0])
    where = ", ".join(str(path) for path in contents)
    source = " and ".join(path.name for path in contents)
    return make_pose_set(cameras, source, where, points, up, dict.fromkeys(notes))


def has_frames(content: Any) -> bool:
    """Whether JSON looks like a transforms.json: an object with frames, or a bare list of them."""
    if isinstance(content, dict):
        return "frames" in content
    return isinstance(content, list) and any(
        isinstance(frame, dict) and "transform_matrix" in frame for frame in content
    )


def _placement(path: Path, content: dict[str, Any]) -> Placement:
    faults = Faults(path.parent)
    placement = read_placement(content, faults, path.name)
    try:
        faults.raise_if_any()
    except SceneError as error:
        raise CaptureError(str(error)) from error
    return placement


def _unplaced(camera: RawCamera, placement: Placement) -> RawCamera:
    position = placement.to_source(camera.matrix[:, 3])
    left = placement.rotation.T @ camera.matrix[:, :3]
    return RawCamera(camera.name, np.column_stack([left, position]), camera.lens, camera.other_names)


def _read_frames(path: Path, content: Any, sizes: PictureSizes, notes: list[str]) -> list[RawCamera]:
    top = content if isinstance(content, dict) else {}
    frames = content.get("frames") if isinstance(content, dict) else content
    if not isinstance(frames, list) or not frames:
        found = "nothing" if frames is None else describe(frames)
        raise CaptureError(f"{path}: 'frames' is {found}; expected a list with one object a view")
    reader = _FrameReader(path, top, sizes, notes)
    cameras = [reader.read(frame, index) for index, frame in enumerate(frames)]
    missing = [camera.name for camera in cameras if not _is_there(path.parent, camera.name)]
    if missing:
        notes.append(
            f"{path.name}: {len(missing)} of {len(cameras)} frames name files that are not there "
            f"({name_some(missing)}); their poses are kept"
        )
    if any(camera.lens is None for camera in cameras):
        notes.append(f"{path.name}: frames without a focal length or picture size have no lens")
    return cameras


def _is_there(folder: Path, name: str) -> bool:
    """Whether a file exists, also where Blender's files leave out the suffix."""
    path = folder / name
    try:
        return path.is_file() or path.with_name(f"{path.name}.png").is_file()
    except (OSError, ValueError):
        return False


class _FrameReader:
    """Frames of one file; lenses that many frames share are made once."""

    def __init__(self, path: Path, top: dict[str, Any], sizes: PictureSizes, notes: list[str]) -> None:
        self._path, self._top, self._sizes, self._notes = path, top, sizes, notes
        self._lenses: dict[str, Lens | None] = {}

    def read(self, frame: Any, index: int) -> RawCamera:
        where = f"{self._path}: frames[{index}]"
        if not isinstance(frame, dict):
            raise CaptureError(f"{where} is {describe(frame)}; expected an object with 'transform_matrix'")
        texts = [frame[key] for key in NAME_KEYS if isinstance(frame.get(key), str) and frame[key].strip()]
        names = [text.removeprefix("./") for text in texts] or [f"#{index:04d}"]
        matrix = read_matrix(frame.get("transform_matrix"), where)
        lens = self._lens({**self._top, **frame}, names[0], where)
        return RawCamera(names[0], matrix, lens, tuple(names[1:]))

    def _lens(self, values: dict[str, Any], name: str, where: str) -> Lens | None:
        numbers = lens_numbers(values, where)
        model = values.get("camera_model", "OPENCV")
        size = size_of(numbers, where) or self._sizes.of(name)
        key = repr((numbers, model, size))
        if key not in self._lenses:
            made = (None, None) if size is None else make_lens(numbers, model, size, where)
            self._lenses[key] = made[0]
            self._notes += [] if made[1] is None else [made[1]]
        return self._lenses[key]


def read_matrix(value: Any, where: str) -> Float64[np.ndarray, "3 4"]:
    """A matrix of 3 or 4 rows, or 12 or 16 numbers row by row; NaN is kept for the check that names all such frames.

    Raises:
        CaptureError: it is something else.
    """
    rows = value
    if isinstance(value, list) and len(value) in (12, 16) and not any(isinstance(row, list) for row in value):
        rows = [value[start : start + 4] for start in range(0, len(value), 4)]
    is_matrix = (
        isinstance(rows, list)
        and len(rows) in (3, 4)
        and all(isinstance(row, list) and len(row) == 4 for row in rows)
    )
    if not is_matrix:
        found = "absent" if value is None else describe(value)
        raise CaptureError(
            f"{where}: 'transform_matrix' is {found}; expected 4 (or 3) rows of 4 numbers, camera to world"
        )
    matrix = np.array([[_or_nan(read_number(number)) for number in row] for row in rows])
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6 and matrix[3].any():
        raise CaptureError(f"{where}: the last row of 'transform_matrix' is {rows[3]}; expected 0, 0, 0, 1")
    return matrix[:3]


def _read_points(
    path: Path, content: dict[str, Any], placement: Placement, notes: list[str]
) -> SparsePoints | None:
    name = content.get("ply_file_path")
    if not isinstance(name, str):
        return None
    try:
        positions, colours = read_ply_points(path.parent / name)
    except (OSError, ValueError) as error:
        notes.append(f"{path.name}: the sparse points of {name} can't be read ({error}); left out")
        return None
    return SparsePoints(placement.to_source(positions), colours)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


RADIAL_KEYS, TANGENTIAL_KEYS = ("k1", "k2", "k3", "k4"), ("p1", "p2")
PLAIN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_KEYS = (
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
    "h",
    "camera_angle_x",
    "camera_angle_y",
    *RADIAL_KEYS,
    *TANGENTIAL_KEYS,
)

Numbers = Mapping[str, float | None]


def lens_numbers(values: Mapping[str, Any], where: str) -> dict[str, float | None]:
    """All numbers that a lens may have; None where they are absent.

    Raises:
        CaptureError: one is not a finite number.
    """
    numbers = {key: _number(values, key, where) for key in _KEYS}
    listed = values.get("distortion_params")
    if isinstance(listed, list) and len(listed) == 6:
        terms = dict(zip((*RADIAL_KEYS, *TANGENTIAL_KEYS), listed, strict=True))
        numbers |= {key: _number(terms, key, where) for key in terms}
    return numbers


def size_of(numbers: Numbers, where: str) -> tuple[int, int] | None:
    """Width and height; None where one is absent.

    Raises:
        CaptureError: no whole pixels above 0.
    """
    width, height = numbers["w"], numbers["h"]
    if width is None or height is None:
        return None
    if width < 1 or height < 1 or width != int(width) or height != int(height):
        raise CaptureError(f"{where}: 'w' and 'h' are {width:g}, {height:g}; expected whole pixels above 0")
    return int(width), int(height)


def make_lens(
    numbers: Numbers, model: Any, size: tuple[int, int], where: str
) -> tuple[Lens | None, str | None]:
    """The lens, None without a focal length, and a note if it is not exactly the one of the file.

    Raises:
        CaptureError: a number is impossible, or the model can't be represented.
    """
    focal = _focal(numbers, size, where)
    if focal is None:
        return None, None
    center = (_or(numbers["cx"], size[0] / 2), _or(numbers["cy"], size[1] / 2))
    radial = tuple(_or(numbers[key], 0.0) for key in RADIAL_KEYS)
    p1, p2 = (_or(numbers[key], 0.0) for key in TANGENTIAL_KEYS)
    plain = Lens(*size, focal, center)
    if model == "OPENCV_FISHEYE":
        return fit_lens(lambda ideal: project_fisheye(ideal, focal, center, radial), plain, model, where)
    if model not in PLAIN_MODELS:
        raise CaptureError(
            f"{where}: camera_model {describe(model)} is not supported; expected one of "
            f"{', '.join((*PLAIN_MODELS, 'OPENCV_FISHEYE'))}: undistort the images first"
        )
    return Lens(*size, focal, center, (radial[0], radial[1], p1, p2), (radial[2], radial[3])), None


def _focal(numbers: Numbers, size: Sequence[int], where: str) -> tuple[float, float] | None:
    focal: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        value, angle = numbers[f"fl_{axis}"], numbers[f"camera_angle_{axis}"]
        if value is None and angle is not None:
            if not 1e-6 < angle < math.pi - 1e-6:
                raise CaptureError(
                    f"{where}: 'camera_angle_{axis}' is {angle:g}; expected radians between 0 and pi"
                )
            value = 0.5 * side / math.tan(0.5 * angle)
        if value is not None and value <= 0:
            raise CaptureError(
                f"{where}: 'fl_{axis}' is {value:g}; expected a focal length above 0 in pixels"
            )
        focal.append(value)
    x, y = focal
    if x is None and y is None:
        return None
    return _or(x, _or(y, 0.0)), _or(y, _or(x, 0.0))


def _number(values: Mapping[str, Any], key: str, where: str) -> float | None:
    if values.get(key) is None:
        return None
    number = read_number(values[key])
    if number is None or abs(number) > 1e9:
        raise CaptureError(f"{where}: '{key}' is {describe(values[key])}; expected a finite number")
    return number


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
