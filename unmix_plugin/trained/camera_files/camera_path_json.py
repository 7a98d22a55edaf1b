"""nerfstudio's camera_path.json: a path in model space, as a viewer of a run keeps it.

Source: nerfstudio 1.1, viewer/render_panel.py and cameras/camera_paths.py: matrices of 16 numbers row by row, OpenGL
axes, vertical field of view in degrees.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.reading.faults import describe, read_number
from unmix_plugin.trained.camera_files.camera_json import (
    CameraFile,
    camera_entries,
    check_frames_per_second,
    check_size,
    needed_number,
    needed_pose,
    one_view,
)
from unmix_plugin.trained.run_views import RunView

_USUAL_FPS = 24


def read_camera_path(path: Path, content: dict[str, Any]) -> CameraFile:
    """The cameras of a file whose content has a `camera_path`; pinholes of the file's size.

    Raises:
        ConfigError: an impossible size, lens or pose, or something that has no counterpart here.
    """
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise ConfigError(f"{path}: camera_type {describe(kind)} is not supported; expected perspective")
    if content.get("crop") is not None:
        raise ConfigError(f"{path}: 'crop' is not supported; take it out to render all of the scene")
    width, height = (needed_number(content, key, path) for key in ("render_width", "render_height"))
    width, height = check_size(width, height, f"{path}: render_width and render_height")
    views = [
        _keyed_view(entry, index, (width, height), path)
        for index, entry in enumerate(camera_entries(content, "camera_path", path))
    ]
    frames_per_second = content.get("fps", _USUAL_FPS)
    return CameraFile(tuple(views), check_frames_per_second(read_number(frames_per_second), f"{path}: 'fps'"))


def _keyed_view(entry: dict[str, Any], index: int, size: tuple[int, int], path: Path) -> RunView:
    where = f"{path}: camera_path[{index}]"
    values = entry.get("camera_to_world")
    if isinstance(values, list) and len(values) == 16:
        values = [values[row : row + 4] for row in range(0, 16, 4)]
    fov_deg = needed_number(entry, "fov", where)
    if not 0 < fov_deg < 180:
        raise ConfigError(f"{where}: 'fov' is {fov_deg:g}; expected degrees between 0 and 180, vertical")
    focal = 0.5 * size[1] / math.tan(math.radians(fov_deg) / 2)
    pose = needed_pose(values, f"camera_path[{index}]", path, "camera_to_world")
    return one_view(
        f"frame_{index:04d}", pose, (focal, focal), (size[0] / 2, size[1] / 2), (0.0, 0.0, 0.0, 0.0), size
    )
