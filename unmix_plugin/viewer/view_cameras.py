"""Between a browser's camera and ours: axes, field of view, image size; everything that comes in is checked here.

Notation: a browser's pose has OpenCV axes (+x right, +y down, +z forward) as a quaternion w, x, y, z and a position in
model space, and the vertical field of view in radians; ours has OpenGL axes and focal lengths in pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    import viser

FOV_BOUNDS = (math.radians(1.0), math.radians(170.0))
"""Least and greatest vertical field of view."""

_ASPECT_BOUNDS = (0.1, 10.0)
_LARGEST_COORDINATE = 1e4
_OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class ViewPose:
    """Where a browser looks from; always finite and within bounds."""

    wxyz: tuple[float, float, float, float]
    """Rotation from camera (OpenCV axes) to model space, unit quaternion."""
    position: tuple[float, float, float]
    """Model space."""
    fov: float
    """Vertical, radians."""
    aspect: float
    """Width over height of the canvas."""


def _checked_pose(wxyz: Any, position: Any, fov: Any, aspect: Any) -> ViewPose:
    """The pose that a browser sent, whatever that is; a ConfigError where nothing can be shown from there."""
    try:
        rotation, place = ([float(value) for value in values] for values in (wxyz, position))
        angle, shape = float(fov), float(aspect)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"the browser sent a camera of something other than numbers: {error}") from error
    numbers = np.array([*rotation, *place, angle, shape])
    if len(rotation) != 4 or len(place) != 3 or not np.isfinite(numbers).all():
        raise ConfigError(f"the browser sent a camera with numbers that are missing or not finite: {numbers}")
    length = float(np.linalg.norm(rotation))
    if length < 1e-6 or np.abs(place).max() > _LARGEST_COORDINATE or shape <= 0:
        raise ConfigError(f"the browser sent a camera that sees nothing: {numbers}; reset the camera")
    w, x, y, z = (value / length for value in rotation)
    low, high = _ASPECT_BOUNDS
    fov = min(max(angle, FOV_BOUNDS[0]), FOV_BOUNDS[1])
    return ViewPose((w, x, y, z), (place[0], place[1], place[2]), fov, min(max(shape, low), high))


def pose_from(camera: viser.CameraHandle) -> ViewPose:
    """The pose of a client's camera; a ConfigError if it is invalid, or its canvas has no size."""
    height, width = camera.image_height, camera.image_width
    has_size = isinstance(height, int) and isinstance(width, int) and height > 0 and width > 0
    aspect = width / height if has_size else math.nan
    return _checked_pose(camera.wxyz, camera.position, camera.fov, aspect)


def camera_of(pose: ViewPose, height: int, largest_pixels: int = 1 << 24) -> Cameras:
    """The pinhole camera of a pose for pictures of `height` rows, fewer where they would exceed `largest_pixels`."""
    height = max(1, min(height, int(math.sqrt(largest_pixels / pose.aspect))))
    return sized_camera(pose, max(1, min(round(height * pose.aspect), largest_pixels // height)), height)


def sized_camera(pose: ViewPose, width: int, height: int) -> Cameras:
    """The pinhole camera of a pose for pictures of a size: the vertical field of view stays, whatever the aspect."""
    focal = height / 2 / math.tan(pose.fov / 2)
    axes = _rotation(pose.wxyz).as_matrix() @ _OPENCV_TO_OPENGL
    camera_to_world = np.concatenate([axes, np.array(pose.position)[:, None]], axis=1)
    return Cameras(
        torch.tensor(camera_to_world, dtype=torch.float32)[None],
        torch.tensor([[focal, focal]], dtype=torch.float32),
        torch.tensor([[width / 2, height / 2]], dtype=torch.float32),
        torch.zeros(1, 4),
        width,
        height,
    )


def pose_of(camera: Cameras) -> ViewPose:
    """The pose from which a browser sees about what one of our cameras sees: centred, without distortion."""
    pose = camera.camera_to_world[0].double().cpu().numpy()
    wxyz = _wxyz(Rotation.from_matrix(pose[:, :3] @ _OPENCV_TO_OPENGL))
    fov = 2 * math.atan(camera.height / 2 / float(camera.focal_px[0, 1]))
    return _checked_pose(wxyz, pose[:, 3], fov, camera.width / camera.height)


def point_ahead(camera: Cameras, box: SceneBox) -> tuple[float, float, float]:
    """The point on the viewing axis that is nearest to the middle of the scene box, but in front of the camera."""
    place, forward = camera.camera_to_world[0, :, 3], -camera.camera_to_world[0, :, 2]
    reach = max(float((box.aabb.mean(dim=0) - place) @ forward), 0.1)
    x, y, z = (place + reach * forward).tolist()
    return x, y, z


_START_TURN_RAD, _START_DISTANCE = math.radians(12.0), 1.25
"""Beside a camera of the scene, about the middle, and how much further from it."""


def beside(camera: Cameras, box: SceneBox, up: tuple[float, float, float]) -> Cameras:
    """Where a page looks from at first: near one of the scene's cameras, but beside it and further back, so that all
    is seen and the camera's own picture does not fill the page. A camera within the scene box stays."""
    place, (low, high) = camera.camera_to_world[0, :, 3], box.aabb.to(camera.camera_to_world)
    if bool(((place > low) & (place < high)).all()):
        return camera
    turn = torch.from_numpy(Rotation.from_rotvec(_START_TURN_RAD * np.array(up)).as_matrix()).to(place)
    middle, pose = torch.tensor(point_ahead(camera, box)).to(place), camera.camera_to_world.clone()
    pose[0, :, :3] = turn @ pose[0, :, :3]
    pose[0, :, 3] = middle + _START_DISTANCE * turn @ (place - middle)
    return replace(camera, camera_to_world=pose)


def _rotation(wxyz: Sequence[Any]) -> Rotation:
    """Rotations of unit quaternions; SciPy has w last."""
    return Rotation.from_quat(np.roll(wxyz, -1, axis=-1))


def _wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def path_poses(key_frames: Sequence[ViewPose], num_frames: int) -> list[ViewPose]:
    """Poses along a path through key frames in the order in which they were set, from the first to the last with even
    time between them: positions and fields of view by splines, turns by slerp. A ConfigError for fewer than two."""
    if len(key_frames) < 2:
        raise ConfigError("a path needs at least two key frames; look from elsewhere and add another one")
    keys = np.arange(len(key_frames), dtype=np.float64)
    times = np.linspace(0.0, keys[-1], num_frames)
    values = np.array([[*pose.position, pose.fov] for pose in key_frames])
    smooth = CubicSpline(keys, values, bc_type="natural")(times)
    turns = _wxyz(Slerp(keys, _rotation([pose.wxyz for pose in key_frames]))(times))
    aspect = key_frames[0].aspect
    return [_checked_pose(wxyz, row[:3], row[3], aspect) for row, wxyz in zip(smooth, turns, strict=True)]
