"""Poses of Polycam's raw data: keyframes/cameras/NUMBER.json, one for each of keyframes/images/NUMBER.jpg.

`t_00` to `t_23` are the rows of camera to world, with OpenGL's axes of the camera and +y of the world up; `fx`, `fy`,
`cx`, `cy`, `width`, `height` in pixels. Cameras that Polycam optimised stand in corrected_cameras.

Sources: Polycam, raw data; nerfstudio, process_data/polycam_utils.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, load_json, make_pose_set
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.json_values import read_number
from unmix_plugin.limits import allow_parts

_CORRECTED, _RAW = "corrected_cameras", "cameras"
_MATRIX = [f"t_{row}{column}" for row in range(3) for column in range(4)]


def is_polycam(content: Any) -> bool:
    """Whether JSON is a camera of Polycam's."""
    return isinstance(content, dict) and all(key in content for key in (*_MATRIX, "fx"))


def find_polycam(folder: Path) -> list[Path]:
    """Cameras in a folder of raw data, its keyframes/, or one of these folders itself; corrected ones if there are."""
    for place in (folder / "keyframes", folder):
        for name in (_CORRECTED, _RAW):
            if found := sorted((place / name).glob("*.json")):
                return found
    return sorted(folder.glob("*.json")) if folder.name in (_CORRECTED, _RAW) else []


def read_polycam(paths: list[Path]) -> PoseSet:
    """Poses of camera files. Raises CaptureError: one is damaged or none of Polycam's."""
    folder = paths[0].parent
    allow_parts(folder, len(paths), "cameras", CaptureError, 1 << 16)
    cameras = []
    for path in paths:
        content = load_json(path)
        if not is_polycam(content):
            raise CaptureError(f"{path} is no camera of Polycam's: it lacks 't_00' to 't_23' or 'fx'")
        keys = [*_MATRIX, "fx", "fy", "cx", "cy", "width", "height"]
        numbers = {key: read_number(content.get(key)) for key in keys}
        if missing := [key for key, value in numbers.items() if value is None]:
            raise CaptureError(f"{path}: {', '.join(missing)} should be numbers")
        values = {key: float(value or 0.0) for key, value in numbers.items()}
        if not (min(values["fx"], values["fy"]) > 0 and 1 <= min(values["width"], values["height"]) <= 1e6):
            raise CaptureError(f"{path}: fx, fy, width or height are not above 0")
        size = round(values["width"]), round(values["height"])
        lens = Lens(*size, (values["fx"], values["fy"]), (values["cx"], values["cy"]))
        pose = np.array([values[key] for key in _MATRIX]).reshape(3, 4)
        cameras.append((path.stem, PosedCamera(pose, lens)))
    up = np.array([0.0, 1.0, 0.0])
    note = "those that Polycam optimised" if folder.name == _CORRECTED else "as the phone tracked them"
    return make_pose_set(cameras, f"Polycam's {folder.name}", str(folder), None, up, [f"cameras are {note}"])
