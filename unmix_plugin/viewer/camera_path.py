"""A path through key frames in the order in which they were set: smooth, with even time between them.

Notation: `F` frames of the path.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.viewer.view_cameras import (
    ViewPose,
    checked_pose,
    quaternion,
    rotation_matrix,
    sized_camera,
)

MOST_KEY_FRAMES = 100
SECONDS_BOUNDS = (0.5, 120.0)
FPS_BOUNDS = (1, 60)


def path_poses(key_frames: Sequence[ViewPose], num_frames: int) -> list[ViewPose]:
    """Poses along the path: through every key frame, positions and fields of view by splines, turns by slerp.

    Args:
        key_frames: At least two.
        num_frames: F, at least two: the first and the last are at the ends.
    Raises:
        ConfigError: fewer than two key frames.
    """
    if len(key_frames) < 2:
        raise ConfigError("a path needs at least two key frames; look from elsewhere and add another one")
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    keys = np.arange(len(key_frames), dtype=np.float64)
    times = np.linspace(0.0, keys[-1], num_frames)
    values = np.array([[*pose.position, pose.fov] for pose in key_frames])
    smooth = CubicSpline(keys, values, bc_type="natural")(times)
    turns = Slerp(keys, Rotation.from_matrix(np.stack([rotation_matrix(pose.wxyz) for pose in key_frames])))
    aspect = key_frames[0].aspect
    return [
        checked_pose(quaternion(rotation), row[:3], float(row[3]), aspect)
        for row, rotation in zip(smooth, turns(times).as_matrix(), strict=True)
    ]


def path_views(poses: Sequence[ViewPose], width: int, height: int) -> list[RunView]:
    """The path as views of a size, for a camera file."""
    return [
        RunView(f"path_{index:04d}", sized_camera(pose, width, height)) for index, pose in enumerate(poses)
    ]
