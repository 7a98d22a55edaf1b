"""Cameras as files: nerfstudio's camera_path.json, and the frames of a transforms.json.

`camera_path` holds a path in model space, as a viewer of a run shows it. `frames` holds poses in the world space of the
scene, or in model space where the file says `"space": "model"`, with the lens keys of transforms.json. What the keys
`applied_transform`, `applied_scale` and `offset` of a scene's own transforms.json did is undone first.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.scenes.placement import read_placement
from unmix_plugin.scenes.reading.faults import Faults, describe, read_number
from unmix_plugin.scenes.reading.transforms_json import read_intrinsics
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.camera_files.camera_json import (
    FORMAT_VERSION,
    CameraFile,
    camera_entries,
    check_frames_per_second,
    check_size,
    needed_pose,
    one_view,
    read_camera_json,
)
from unmix_plugin.trained.camera_files.camera_path_json import read_camera_path
from unmix_plugin.trained.run_views import RunView


def read_camera_file(path: Path, frame: Normalisation) -> CameraFile:
    """Read the cameras of a file; `frame` leads from world to model space.

    Raises:
        ConfigError: it is missing, empty, no camera file, from a newer version, or a camera in it is impossible.
    """
    content = read_camera_json(path)
    try:
        if "camera_path" in content:
            return read_camera_path(path, content)
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
    """The cameras as JSON that `read_camera_file` reads, in world space.

    Args:
        views: All of one size, model space.
        frames_per_second: Of a path; None for single views.
        frame: From world to model space.
    """
    camera = views[0].camera
    content = {
        "format_version": FORMAT_VERSION,
        "space": "world",
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        **({} if frames_per_second is None else {"fps": frames_per_second}),
        "frames": [_frame_entry(view, frame) for view in views],
    }
    return (json.dumps(content, indent=1) + "\n").encode()


def _read_frames(path: Path, content: dict[str, Any], frame: Normalisation) -> CameraFile:
    space = content.get("space", "world")
    if space not in ("world", "model"):
        raise ConfigError(f"{path}: 'space' is {describe(space)}; expected world or model")
    entries = camera_entries(content, "frames", path)
    names = _names(entries, path)
    faults = Faults(path)
    placement = read_placement(content, faults, path.name)
    faults.raise_if_any()
    views = []
    for index, (entry, name) in enumerate(zip(entries, names, strict=True)):
        pose = needed_pose(entry.get("transform_matrix"), f"frames[{index}]", path, "transform_matrix")
        if space == "world":
            position = frame.to_model(placement.to_source(pose[:, 3]))
            rotation = frame.rotation @ placement.rotation.T @ pose[:, :3]
            pose = np.concatenate([rotation, position[:, None]], axis=1)
        views.append(_frame_view(name, pose, {**content, **entry}, index, path))
    sizes = {(view.camera.width, view.camera.height) for view in views}
    if len(sizes) > 1:
        raise ConfigError(f"{path}: frames have the sizes {sorted(sizes)}; expected one size for all")
    if "fps" not in content:
        return CameraFile(tuple(views), None)
    return CameraFile(tuple(views), check_frames_per_second(read_number(content["fps"]), f"{path}: 'fps'"))


def _frame_view(
    name: str, pose: Float64[np.ndarray, "3 4"], values: dict[str, Any], index: int, path: Path
) -> RunView:
    where = f"frames[{index}]"
    faults = Faults(path)
    lens = read_intrinsics({}, values, where, faults)
    faults.raise_if_any()
    assert lens is not None
    if lens.width is None or lens.height is None:
        raise ConfigError(
            f"{path}: {where}: 'w' and 'h' are absent; expected the size of the picture in pixels"
        )
    width, height = check_size(lens.width, lens.height, f"{path}: {where}")
    x, y = lens.center_px
    centre = (width / 2 if x is None else x, height / 2 if y is None else y)
    focal_px = lens.focal_at(width, height)
    assert focal_px is not None
    return one_view(name, pose, focal_px, centre, lens.coefficients, (width, height))


def _names(entries: Sequence[dict[str, Any]], path: Path) -> list[str]:
    """`name` of the frames, otherwise the name of their picture or cube, otherwise numbers."""
    numbers = [f"frame_{index:04d}" for index in range(len(entries))]
    for key in ("name", "file_path", "hyperspectral_file_path"):
        values = [entry.get(key) for entry in entries]
        if not all(isinstance(value, str) and value for value in values):
            continue
        stems = [str(value) if key == "name" else Path(str(value)).stem for value in values]
        names = [re.sub(r"[^\w.+-]", "_", stem).strip(".") for stem in stems]
        if all(names) and len(set(names)) == len(names):
            return names
        if key == "name":
            raise ConfigError(f"{path}: two frames have one name, or a name that no file can have")
    return numbers


def _frame_entry(view: RunView, frame: Normalisation) -> dict[str, Any]:
    camera = view.camera
    pose = camera.camera_to_world[0].double().cpu().numpy()
    position = frame.to_world(pose[:, 3])
    pose = np.concatenate([frame.rotation.T @ pose[:, :3], position[:, None]], axis=1)
    lens = torch.cat([camera.focal_px, camera.center_px, camera.distortion], dim=1)[0].tolist()
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")[: len(lens)]
    matrix = [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
    return {"name": view.name, "transform_matrix": matrix, **dict(zip(keys, lens, strict=True))}
