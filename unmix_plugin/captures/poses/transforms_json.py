"""Poses of transforms.json: nerfstudio's, Blender's with `camera_angle_x`, bare lists, rotations with scale."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.lens import Lens, fit_lens, project_fisheye
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, SparsePoints, make_pose_set, name_some
from unmix_plugin.errors import CaptureError, SceneError
from unmix_plugin.formats.meshes import read_ply_points
from unmix_plugin.scenes.placement import Placement, read_placement
from unmix_plugin.scenes.reading.faults import Faults, describe, read_number
from unmix_plugin.scenes.reading.transforms_json import FILE_NAME, Intrinsics, read_lens

Size: TypeAlias = tuple[int, int]
"""Width, height in pixels."""
_NAME_KEYS = ("file_path", "hyperspectral_file_path", "name")
"""Of a frame: the first that is there names its image."""
_PLAIN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")


def has_frames(content: Any) -> bool:
    """Whether JSON looks like a transforms.json: an object with frames, or a bare list of them."""
    if isinstance(content, dict):
        return "frames" in content
    return isinstance(content, list) and any(
        isinstance(frame, dict) and "transform_matrix" in frame for frame in content
    )


def read_transforms(contents: Mapping[Path, Any], sizes: Mapping[str, Size]) -> PoseSet:
    """Poses of one transforms.json, or of one for each split.

    Args:
        contents: JSON of the files.
        sizes: Of pictures by name, file name or stem, where neither the files nor the pictures themselves tell them.
    Raises:
        CaptureError: no list of frames, a frame without a sound pose, or a lens that can't be represented.
    """
    cameras: list[tuple[str, PosedCamera]] = []
    notes: list[str] = []
    points: SparsePoints | None = None
    up = np.array([0.0, 0.0, 1.0])
    for path, content in contents.items():
        top = content if isinstance(content, dict) else {}
        faults = Faults(path.parent if path.name == FILE_NAME else path)
        placement = read_placement(top, faults, path.name)
        found = _read_frames(path, content, sizes, faults, notes)
        try:
            faults.raise_if_any()
        except SceneError as error:
            raise CaptureError(str(error)) from error
        if not placement.is_identity:
            notes.append(f"{path.name}: applied_transform and applied_scale are undone")
        for (name, *others), matrix, lens in found:
            position = placement.to_source(matrix[:, 3])
            matrix = np.column_stack([placement.rotation.T @ matrix[:, :3], position])
            cameras.append((name, PosedCamera(matrix, lens, tuple(others))))
        points = points or _read_points(path, top, placement, notes)
        up = placement.rotation.T @ np.array([0.0, 0.0, 1.0])
    where = ", ".join(str(path) for path in contents)
    source = " and ".join(path.name for path in contents)
    return make_pose_set(cameras, source, where, points, up, dict.fromkeys(notes))


def _read_frames(
    path: Path, content: Any, sizes: Mapping[str, Size], faults: Faults, notes: list[str]
) -> list[tuple[list[str], Float64[np.ndarray, "3 4"], Lens | None]]:
    """Names, matrix and lens of each frame, in the file's own world."""
    top = content if isinstance(content, dict) else {}
    frames = content.get("frames") if isinstance(content, dict) else content
    if not isinstance(frames, list) or not frames:
        found = "nothing" if frames is None else describe(frames)
        raise CaptureError(f"{path}: 'frames' is {found}; expected a list with one object a view")
    lenses: dict[str, tuple[Lens | None, str | None]] = {}
    read, missing = [], []
    for index, frame in enumerate(frames):
        where = f"{path}: frames[{index}]"
        if not isinstance(frame, dict):
            raise CaptureError(f"{where} is {describe(frame)}; expected an object with 'transform_matrix'")
        texts = [frame[key] for key in _NAME_KEYS if isinstance(frame.get(key), str) and frame[key].strip()]
        names = [text.removeprefix("./") for text in texts] or [f"#{index:04d}"]
        matrix = _read_matrix(frame.get("transform_matrix"), where)
        given = read_lens(top, frame, f"frames[{index}]", faults)
        lens = None
        if given is not None:
            if given.width is not None and given.height is not None:
                size = (given.width, given.height)
            else:
                size = _size_of(path.parent, names[0], sizes)
            key = repr((given, size))  # many frames share a lens, which takes long to fit
            if key not in lenses:
                lenses[key] = (None, None) if size is None else _make_lens(given, size, where)
                notes += [note for note in lenses[key][1:] if note is not None]
            lens = lenses[key][0]
        read.append((names, matrix, lens))
        missing += [] if _is_there(path.parent / names[0]) else [names[0]]
    if missing:
        notes.append(
            f"{path.name}: {len(missing)} of {len(read)} frames name files that are not there ({name_some(missing)}); "
            "their poses are kept"
        )
    if any(lens is None for _, _, lens in read):
        notes.append(f"{path.name}: frames without a focal length or picture size have no lens")
    return read


def _is_there(path: Path) -> bool:
    """Whether a file exists, also where Blender's files leave out the suffix."""
    try:
        return path.is_file() or path.with_name(f"{path.name}.png").is_file()
    except (OSError, ValueError):
        return False


def _size_of(folder: Path, name: str, given: Mapping[str, Size]) -> Size | None:
    """Size of a picture: among those given, otherwise in the file itself."""
    from PIL import Image

    path = PurePosixPath(name.replace("\\", "/"))
    for key in (name, path.name, path.stem):
        if key in given:
            return given[key]
    if len(set(given.values())) == 1:
        return next(iter(given.values()))
    try:
        with Image.open(folder / name) as picture:
            return picture.size
    except (OSError, ValueError, Image.DecompressionBombError):
        return None


def _make_lens(given: Intrinsics, size: Size, where: str) -> tuple[Lens | None, str | None]:
    """The lens, None without a focal length, and a note if it is not exactly the one of the file."""
    focal = given.focal_at(*size)
    if focal is None:
        return None, None
    x, y = given.center_px
    center = (size[0] / 2 if x is None else x, size[1] / 2 if y is None else y)
    if given.model == "OPENCV_FISHEYE":
        terms = (*given.distortion[:2], *given.higher_radial)
        start = Lens(*size, focal, center)
        return fit_lens(lambda ideal: project_fisheye(ideal, focal, center, terms), start, given.model, where)
    if given.model not in _PLAIN_MODELS:
        raise CaptureError(
            f"{where}: camera_model {describe(given.model)} is not supported; expected one of "
            f"{', '.join((*_PLAIN_MODELS, 'OPENCV_FISHEYE'))}: undistort the images first"
        )
    return Lens(*size, focal, center, given.distortion, given.higher_radial), None


def _read_matrix(value: Any, where: str) -> Float64[np.ndarray, "3 4"]:
    """A matrix of 3 or 4 rows, or 12 or 16 numbers row by row; NaN is kept for the check that names all such frames."""
    rows = value
    if isinstance(value, list) and len(value) in (12, 16) and not any(isinstance(row, list) for row in value):
        rows = [value[start : start + 4] for start in range(0, len(value), 4)]
    is_matrix = isinstance(rows, list) and len(rows) in (3, 4)
    if not is_matrix or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        found = "absent" if value is None else describe(value)
        raise CaptureError(
            f"{where}: 'transform_matrix' is {found}; expected 4 (or 3) rows of 4 numbers, camera to world"
        )
    numbers = [[read_number(number) for number in row] for row in rows]
    matrix = np.array([[math.nan if number is None else number for number in row] for row in numbers])
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
    return placement.to_source(positions), colours
