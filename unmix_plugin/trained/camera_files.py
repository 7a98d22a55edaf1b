"""Cameras as files: nerfstudio's camera_path.json, and the frames of a transforms.json.

`camera_path` holds a path in model space, as a viewer of a run shows it. `frames` holds poses in the world space of the
scene, or in model space where the file says `"space": "model"`, with the lens keys of transforms.json, and of line
cameras with `key_poses` or `row_poses` in place of `transform_matrix`. What the keys `applied_transform`,
`applied_scale` and `offset` of a scene's own transforms.json did is undone first.

Source: nerfstudio 1.1, viewer/render_panel.py and cameras/camera_paths.py: matrices of 16 numbers row by row, OpenGL
axes, vertical field of view in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import torch
from jaxtyping import Float64
from msgspec import Meta

from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import safe_name
from unmix_plugin.formats.json_values import describe, read_keys, read_number
from unmix_plugin.limits import UnreadableJsonError, read_json
from unmix_plugin.scenes.folder import (
    Transforms,
    lens_keys,
    matrix_entry,
    parse_transforms,
    transforms_bytes,
)
from unmix_plugin.scenes.frame_cameras import FrameCamera, Intrinsics, make_cameras, read_pose
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.placement import read_placement
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import RunView

_FORMAT_VERSION = 1
"""Of the camera files that we write."""
_GREATEST_SIDE_PX = 16_384
_LEAST_DEG = 1e-4
"""Of a field of view, and from 180 degrees on: beyond, focal lengths leave float32."""
_GREATEST_FPS, _USUAL_FPS = 1000, 24

_Number = Annotated[float, Meta(ge=-1e300, le=1e300, description="a number")]


class _FileKeys(msgspec.Struct, kw_only=True, frozen=True):
    """Keys of a camera file beside its cameras."""

    space: Annotated[Literal["world", "model"], Meta(description="world or model")] | None = None
    camera_type: Annotated[Literal["perspective"], Meta(description="perspective")] | None = None
    render_width: _Number | None = None
    render_height: _Number | None = None


class _PathKeys(msgspec.Struct, kw_only=True, frozen=True):
    """Keys of a camera in nerfstudio's path."""

    camera_to_world: Any = None
    fov: (
        Annotated[
            float,
            Meta(ge=_LEAST_DEG, le=180 - _LEAST_DEG, description="degrees between 0 and 180, vertical"),
        ]
        | None
    ) = None


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
        content = read_json(path)
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
    if "camera_path" not in content and "frames" not in content:
        keys = ", ".join(sorted(content)) or "none"
        raise ConfigError(
            f"{path} is not a camera file: expected 'camera_path', as in nerfstudio's camera_path.json, or 'frames', "
            f"as in transforms.json; found the keys {keys}"
        )
    is_path = "camera_path" in content
    faults = Faults(path)
    keys = read_keys(content, _FileKeys, partial(faults.note, str(path), Message.WRONG_VALUE))
    cameras = parse_transforms(content, faults, "camera_path" if is_path else "frames", "camera")
    faults.raise_if_any(ConfigError)
    if not cameras.frames:
        raise ConfigError(
            f"{path}: '{'camera_path' if is_path else 'frames'}' is empty; expected at least one camera"
        )
    views = (
        _read_path(path, keys, content, cameras.frames)
        if is_path
        else _read_frames(path, keys, cameras, frame)
    )
    if not is_path and "fps" not in content:
        return _CameraFile(views, None)
    fps = read_number(content.get("fps", _USUAL_FPS))
    return _CameraFile(views, check_frames_per_second(fps, f"{path}: 'fps'"))


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
    return transforms_bytes(content)


def camera_entry(view: RunView, frame: Normalisation) -> dict[str, Any]:
    """Name, lens and pose of a view as the frames of transforms.json have them; of a line camera `key_poses`."""
    camera = view.camera

    def matrix(pose: torch.Tensor) -> list[list[float]]:
        values = pose.double().cpu().numpy()
        return matrix_entry(np.column_stack([frame.rotation.T @ values[:, :3], frame.to_world(values[:, 3])]))

    lens = (each[0].tolist() for each in (camera.focal_px, camera.center_px, camera.distortion))
    entry = {"name": view.name, **lens_keys(*lens)}
    if camera.key_poses is None:
        return {**entry, "transform_matrix": matrix(camera.camera_to_world[0])}
    heights = camera.key_poses.heights.clone()  # those of enlarged images end within their first and last row
    heights[0], heights[-1] = heights[0].clamp(max=0.5), heights[-1].clamp(min=camera.height - 0.5)
    poses = camera.key_poses.at(torch.zeros_like(heights, dtype=torch.int64), heights)
    keys = zip(heights.tolist(), poses, strict=True)
    return {**entry, "key_poses": [{"row": y - 0.5, "transform_matrix": matrix(pose)} for y, pose in keys]}


def _read_path(
    path: Path, keys: _FileKeys, content: Mapping[str, Any], entries: Sequence[tuple[str, dict[str, Any]]]
) -> tuple[RunView, ...]:
    """The cameras of a nerfstudio path: pinholes of the file's size."""
    if content.get("crop") is not None:
        raise ConfigError(f"{path}: 'crop' is not supported; take it out to render all of the scene")
    for key in ("render_width", "render_height"):
        if getattr(keys, key) is None:
            raise ConfigError(f"{path}: '{key}' is absent; expected a number")
    width, height = check_size(
        keys.render_width or 0, keys.render_height or 0, f"{path}: render_width and render_height"
    )
    views = []
    for index, (where, entry) in enumerate(entries):
        faults = Faults(path)
        own = read_keys(entry, _PathKeys, partial(faults.note, where, Message.WRONG_VALUE))
        if entry.get("fov") is None:
            faults.add(where, "'fov' is absent; expected a number")
        values = own.camera_to_world
        if isinstance(values, list) and len(values) == 16:
            values = [values[row : row + 4] for row in range(0, 16, 4)]
        pose = read_pose(values, where, faults, "'camera_to_world'")
        faults.raise_if_any(ConfigError)
        focal = 0.5 * height / math.tan(math.radians(own.fov or 0.0) / 2)
        lens = Intrinsics("PINHOLE", width, height, (focal, focal))
        camera = make_cameras([FrameCamera(lens, pose)], [(width, height)], lambda poses: poses)
        views.append(RunView(f"frame_{index:04d}", camera))
    return tuple(views)


def _read_frames(
    path: Path, keys: _FileKeys, cameras: Transforms, frame: Normalisation
) -> tuple[RunView, ...]:
    """The cameras of a transforms.json, of one size."""
    names, faults = _names([entry for _, entry in cameras.frames], path), Faults(path)
    placement, _ = read_placement(cameras.scene, path.name, faults)
    faults.raise_if_any(ConfigError)

    def to_model(poses: Float64[np.ndarray, "n 3 4"]) -> Float64[np.ndarray, "n 3 4"]:
        if keys.space == "model":
            return poses
        positions = frame.to_model(placement.to_source(poses[:, :, 3]))
        rotations = frame.rotation @ placement.rotation.T @ poses[:, :, :3]
        return np.concatenate([rotations, positions[:, :, None]], axis=2)

    views = []
    for (where, entry), name in zip(cameras.frames, names, strict=True):
        camera = FrameCamera.read(cameras.scene, entry, where, faults)
        faults.raise_if_any(ConfigError)
        lens = camera.lens
        assert lens is not None
        if lens.width is None or lens.height is None:
            raise ConfigError(
                f"{path}: {where}: 'w' and 'h' are absent; expected the size of the picture in pixels"
            )
        size = check_size(lens.width, lens.height, f"{path}: {where}")
        camera = camera.at_size(size[1], where, faults)
        faults.raise_if_any(ConfigError)
        views.append(RunView(name, make_cameras([camera], [size], to_model)))
    sizes = {(view.camera.width, view.camera.height) for view in views}
    if len(sizes) > 1:
        raise ConfigError(f"{path}: frames have the sizes {sorted(sizes)}; expected one size for all")
    return tuple(views)


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
