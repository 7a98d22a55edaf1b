"""Cameras as files: nerfstudio's camera_path.json, and the frames of a transforms.json.

`camera_path` holds a path in model space, as a viewer of a run shows it. `frames` holds poses in the world space of the
scene, or in model space where the file says `"space": "model"`, with the lens keys of transforms.json, and of line
cameras with `key_poses` or `row_poses` in place of `transform_matrix`. What the keys `applied_transform`,
`applied_scale` and `offset` of a scene's own transforms.json did is undone first.

Source: nerfstudio 1.1, viewer/render_panel.py and cameras/camera_paths.py: matrices of 16 numbers row by row, OpenGL
axes, vertical field of view in degrees.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.formats.files import safe_name
from unmix_plugin.scenes.placement import read_placement
from unmix_plugin.scenes.reading.faults import (
    Faults,
    UnreadableJsonError,
    describe,
    read_json_file,
    read_number,
)
from unmix_plugin.scenes.reading.lenses import read_intrinsics
from unmix_plugin.scenes.reading.transforms_json import read_line_poses, read_pose
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import RunView

_FORMAT_VERSION = 1
"""Of the camera files that we write."""
_GREATEST_SIDE_PX = 16_384
_LEAST_DEG = 1e-4
"""Of a field of view, and from 180 degrees on: beyond, focal lengths leave float32."""
_GREATEST_FPS, _USUAL_FPS = 1000, 24
_LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")


@dataclass(frozen=True)
class _CameraFile:
    """What a camera file says."""

    views: tuple[RunView, ...]
    """At least one; all of one size, in model space, with different names fit for file names."""
    frames_per_second: float | None
    """Where the cameras are a path; None where they are single views."""


def check_size(width: float | int, height: float | int, where: str) -> tuple[int, int]:
    """Width and height of a picture in pixels: whole numbers from 1 to 16384, or a ConfigError."""
    if not all(side == int(side) and 1 <= side <= _GREATEST_SIDE_PX for side in (width, height)):
        raise ConfigError(
            f"{where}: {width:g} x {height:g} pixels; expected whole numbers from 1 to {_GREATEST_SIDE_PX}"
        )
    return int(width), int(height)


def check_frames_per_second(value: float | int | None, where: str) -> float:
    """Frames a second of a video: above 0 and at most 1000, or a ConfigError."""
    if value is None or not 0 < value <= _GREATEST_FPS:
        raise ConfigError(
            f"{where}: {value} frames a second; expected a number above 0, at most {_GREATEST_FPS}"
        )
    return float(value)


def read_camera_file(path: Path, frame: Normalisation) -> _CameraFile:
    """Read the cameras of a file, or raise a ConfigError; `frame` leads from world to model space."""
    try:
        content = read_json_file(path)
    except OSError as error:
        raise ConfigError(f"can't read the camera file {path}: {error.strerror or error}") from error
    except UnreadableJsonError as error:
        raise ConfigError(f"{path} {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} holds {describe(content)}; expected an object with cameras")
    version = content.get("format_version", _FORMAT_VERSION)
    if version != _FORMAT_VERSION:
        raise ConfigError(
            f"{path} has format_version {describe(version)}; this version reads {_FORMAT_VERSION}: update this package "
            "or write the file again"
        )
    try:
        if "camera_path" in content:
            return _read_camera_path(path, content)
        if "frames" in content:
            return _read_frames(path, content, frame)
    except SceneError as error:
        raise ConfigError(str(error)) from error
    keys = ", ".join(sorted(content)) or "none"
    raise ConfigError(
        f"{path} is not a camera file: expected 'camera_path', as in nerfstudio's camera_path.json, or 'frames', as in "
        f"transforms.json; found the keys {keys}"
    )


def camera_file_bytes(
    views: Sequence[RunView], frames_per_second: float | None, frame: Normalisation
) -> bytes:
    """Cameras of one size as JSON that `read_camera_file` reads, in world space; a path where there is a speed."""
    camera = views[0].camera
    content = {
        "format_version": _FORMAT_VERSION,
        "space": "world",
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        **({} if frames_per_second is None else {"fps": frames_per_second}),
        "frames": [camera_entry(view, frame) for view in views],
    }
    return (json.dumps(content, indent=1) + "\n").encode()


def camera_entry(view: RunView, frame: Normalisation) -> dict[str, Any]:
    """Name, lens and pose of a view as the frames of transforms.json have them; of a line camera `key_poses`."""
    camera = view.camera

    def matrix(pose: torch.Tensor) -> list[list[float]]:
        values = pose.double().cpu().numpy()
        rows = np.column_stack([frame.rotation.T @ values[:, :3], frame.to_world(values[:, 3])])
        return [*rows.tolist(), [0.0, 0.0, 0.0, 1.0]]

    lens = torch.cat([camera.focal_px, camera.center_px, camera.distortion], dim=1)[0].tolist()
    entry = {"name": view.name, **dict(zip(_LENS_KEYS, lens, strict=False))}
    if camera.key_poses is None:
        return {**entry, "transform_matrix": matrix(camera.camera_to_world[0])}
    heights = camera.key_poses.heights.clone()  # those of enlarged images end within their first and last row
    heights[0], heights[-1] = heights[0].clamp(max=0.5), heights[-1].clamp(min=camera.height - 0.5)
    poses = camera.key_poses.at(torch.zeros_like(heights, dtype=torch.int64), heights)
    keys = zip(heights.tolist(), poses, strict=True)
    return {**entry, "key_poses": [{"row": y - 0.5, "transform_matrix": matrix(pose)} for y, pose in keys]}


def _read_camera_path(path: Path, content: dict[str, Any]) -> _CameraFile:
    """The cameras of a nerfstudio path: pinholes of the file's size."""
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise ConfigError(f"{path}: camera_type {describe(kind)} is not supported; expected perspective")
    if content.get("crop") is not None:
        raise ConfigError(f"{path}: 'crop' is not supported; take it out to render all of the scene")
    sides = [_needed_number(content, key, path) for key in ("render_width", "render_height")]
    width, height = check_size(sides[0], sides[1], f"{path}: render_width and render_height")
    views = []
    for index, entry in enumerate(_entries(content, "camera_path", path)):
        values = entry.get("camera_to_world")
        if isinstance(values, list) and len(values) == 16:
            values = [values[row : row + 4] for row in range(0, 16, 4)]
        fov_deg = _needed_number(entry, "fov", f"{path}: camera_path[{index}]")
        if not _LEAST_DEG <= fov_deg <= 180 - _LEAST_DEG:
            raise ConfigError(
                f"{path}: camera_path[{index}]: 'fov' is {fov_deg:g}; expected degrees between 0 and 180, vertical"
            )
        focal = 0.5 * height / math.tan(math.radians(fov_deg) / 2)
        faults = Faults(path)
        pose = read_pose(values, f"camera_path[{index}]", faults, "'camera_to_world'")
        faults.raise_if_any()
        assert pose is not None
        camera = _camera(pose, (focal, focal), (width / 2, height / 2), (0.0,) * 4, (width, height))
        views.append(RunView(f"frame_{index:04d}", camera))
    fps = read_number(content.get("fps", _USUAL_FPS))
    return _CameraFile(tuple(views), check_frames_per_second(fps, f"{path}: 'fps'"))


def _read_frames(path: Path, content: dict[str, Any], frame: Normalisation) -> _CameraFile:
    space = content.get("space", "world")
    if space not in ("world", "model"):
        raise ConfigError(f"{path}: 'space' is {describe(space)}; expected world or model")
    entries = _entries(content, "frames", path)
    names, faults = _names(entries, path), Faults(path)
    placement = read_placement(content, faults, path.name)
    faults.raise_if_any()

    def in_model(poses: Float64[np.ndarray, "n 3 4"]) -> Float64[np.ndarray, "n 3 4"]:
        if space == "model":
            return poses
        positions = frame.to_model(placement.to_source(poses[:, :, 3]))
        rotations = frame.rotation @ placement.rotation.T @ poses[:, :, :3]
        return np.concatenate([rotations, positions[:, :, None]], axis=2)

    views = []
    for index, (entry, name) in enumerate(zip(entries, names, strict=True)):
        where = f"frames[{index}]"
        lines = read_line_poses(entry, where, faults)
        has_rows = lines is not None or faults.noted > 0
        pose = None if has_rows else read_pose(entry.get("transform_matrix"), where, faults)
        lens = read_intrinsics(content, entry, where, faults)
        faults.raise_if_any()
        assert lens is not None
        if lens.width is None or lens.height is None:
            raise ConfigError(
                f"{path}: {where}: 'w' and 'h' are absent; expected the size of the picture in pixels"
            )
        width, height = check_size(lens.width, lens.height, f"{path}: {where}")
        middle = [
            0.5 * side if x is None else x for x, side in zip(lens.center_px, (width, height), strict=True)
        ]
        focal_px = lens.focal_at(width, height, lines is not None)
        assert focal_px is not None
        keys = None
        if lines is not None:
            if (fault := lines.fault(height)) is not None:
                raise ConfigError(f"{path}: {where}: {fault}")
            pose = lines.middle(height)
            poses, heights = (torch.from_numpy(x).float() for x in (in_model(lines.poses), lines.rows + 0.5))
            keys = KeyPoses(poses, heights, (len(heights),))
        assert pose is not None
        camera = _camera(in_model(pose[None])[0], focal_px, middle, lens.coefficients, (width, height), keys)
        views.append(RunView(name, camera))
    sizes = {(view.camera.width, view.camera.height) for view in views}
    if len(sizes) > 1:
        raise ConfigError(f"{path}: frames have the sizes {sorted(sizes)}; expected one size for all")
    if "fps" not in content:
        return _CameraFile(tuple(views), None)
    return _CameraFile(tuple(views), check_frames_per_second(read_number(content["fps"]), f"{path}: 'fps'"))


def _camera(
    pose: Float64[np.ndarray, "3 4"],
    focal_px: Sequence[float],
    center_px: Sequence[float],
    distortion: Sequence[float],
    size: tuple[int, int],
    keys: KeyPoses | None = None,
) -> Cameras:
    matrix, focal, center, bending = (
        torch.tensor(np.array([x]), dtype=torch.float32) for x in (pose, focal_px, center_px, distortion)
    )
    return Cameras(matrix, focal, center, bending, *size, key_poses=keys)


def _entries(content: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    """The objects in a list, one a camera; a ConfigError for anything else, and for an empty list."""
    entries = content[key]
    if not isinstance(entries, list):
        raise ConfigError(f"{path}: '{key}' is {describe(entries)}; expected a list with one object a camera")
    if not entries:
        raise ConfigError(f"{path}: '{key}' is empty; expected at least one camera")
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ConfigError(f"{path}: {key}[{index}] is {describe(entry)}; expected an object")
    return entries


def _needed_number(values: dict[str, Any], key: str, where: Path | str) -> float:
    number = read_number(values.get(key))
    if number is None:
        found = describe(values[key]) if key in values else "absent"
        raise ConfigError(f"{where}: '{key}' is {found}; expected a number")
    return number


def _names(entries: Sequence[dict[str, Any]], path: Path) -> list[str]:
    """`name` of the frames, otherwise the name of their picture or cube, otherwise numbers; names that would give one
    file are numbered."""
    numbers = [f"frame_{index:04d}" for index in range(len(entries))]
    for key in ("name", "file_path", "hyperspectral_file_path"):
        values = [entry.get(key) for entry in entries]
        if not all(isinstance(value, str) and value for value in values):
            continue
        stems = [str(value) if key == "name" else Path(str(value)).stem for value in values]
        names = [safe_name(stem) for stem in stems]
        if len({name.casefold() for name in names}) == len(names):
            return names
        if key == "name" and len(set(stems)) < len(stems):
            raise ConfigError(f"{path}: two frames have one name")
        if key == "name":
            return [safe_name(f"{index}_{name}") for index, name in enumerate(names)]
    return numbers
