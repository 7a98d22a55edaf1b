"""Poses of all lenses of a rig from those of some.

Where two lenses have poses in the same releases, their offset follows from these. Otherwise the rotations that the
files give are used, and the lenses are taken to be in one place (`RigRelatives`: Euler angles in degrees, R = Rx Ry Rz,
from the axes of the lens to those of the reference lens, with +x right, +y down, +z forward).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.camera_tags import tag_numbers
from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.errors import counted

Pose: TypeAlias = Float64[np.ndarray, "4 4"]
Offsets: TypeAlias = dict[tuple[str, str], Pose]
"""From the camera space of the second lens to that of the first, by the names of both, OpenGL axes."""
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])


def complete_rigs(
    views: Sequence[CaptureView], cameras: Mapping[str, PosedCamera]
) -> tuple[dict[str, PosedCamera], tuple[str, ...]]:
    """Give views without pose that of another lens of the same release, moved by the rig.

    Args:
        views: Of any layout; those without `release` are left as they are.
        cameras: By the name of the view, for some of them.
    Returns:
        Cameras of more views, and what was done, one sentence a lens.
    """
    releases: dict[str, list[CaptureView]] = defaultdict(list)
    for view in views:
        if view.release:
            releases[view.release].append(view)
    offsets = _measured_offsets(releases, cameras)
    measured = set(offsets)
    completed, how = dict(cameras), Counter[tuple[str, str]]()
    for members in releases.values():
        posed = [view for view in members if view.name in cameras]
        for view in members:
            if view.name in cameras:
                continue
            base, offset = _offset_to(view, posed, offsets)
            if base is None or offset is None:
                how[(view.sensor, "unknown" if posed else "unposed")] += 1
                continue
            pose = _square(cameras[base.name].camera_to_world) @ offset
            completed[view.name] = PosedCamera(pose[:3], view.lens)
            how[(view.sensor, "poses" if (base.sensor, view.sensor) in measured else "files")] += 1
    return completed, tuple(_say(sensor, kind, count) for (sensor, kind), count in how.items())


def _say(sensor: str, kind: str, count: int) -> str:
    return (
        f"{counted(count, 'view')} of lens {sensor} "
        + {
            "unposed": "left out: no lens of their release has a pose",
            "unknown": "left out: there is no pose, and nothing says where the lens is on the rig",
            "poses": "got the pose of another lens of their release, moved as in other releases",
            "files": "got the pose of another lens of their release, turned as the files say, at the same place",
        }[kind]
    )


def _offset_to(
    view: CaptureView, posed: Sequence[CaptureView], offsets: Offsets
) -> tuple[CaptureView | None, Pose | None]:
    """A posed view of the release and the offset from it, measured ones first."""
    for base in posed:
        if (base.sensor, view.sensor) in offsets:
            return base, offsets[base.sensor, view.sensor]
    rotation = rig_rotation(view)
    for base in posed:
        other = rig_rotation(base)
        if rotation is not None and other is not None:
            offset = np.eye(4)
            offset[:3, :3] = OPENCV_TO_OPENGL @ other.T @ rotation @ OPENCV_TO_OPENGL
            return base, offset
    return None, None


def rig_rotation(view: CaptureView) -> Float64[np.ndarray, "3 3"] | None:
    """From the axes of the lens to those of the reference lens, as the file says; None where it doesn't."""
    angles = tag_numbers(view.cube.metadata.get("xmp") or {}, "RigRelatives")
    if angles is None or len(angles) != 3 or not np.isfinite(angles).all():
        return None
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.deg2rad(angles)), np.sin(np.deg2rad(angles))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_x @ about_y @ about_z


def _measured_offsets(
    releases: Mapping[str, Sequence[CaptureView]], cameras: Mapping[str, PosedCamera]
) -> Offsets:
    """Offsets between lenses with poses in one release: mean rotation, median place."""
    found: dict[tuple[str, str], list[Pose]] = defaultdict(list)
    for members in releases.values():
        poses = {
            view.sensor: _square(cameras[view.name].camera_to_world)
            for view in members
            if view.name in cameras
        }
        for first, base in poses.items():
            for second, other in poses.items():
                if first != second:
                    found[first, second].append(np.linalg.inv(base) @ other)
    return {pair: _mean(np.stack(offsets)) for pair, offsets in found.items()}


def _mean(offsets: Float64[np.ndarray, "N 4 4"]) -> Pose:
    left, _, right = np.linalg.svd(offsets[:, :3, :3].mean(axis=0))
    mean = np.eye(4)
    mean[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    mean[:3, 3] = np.median(offsets[:, :3, 3], axis=0)
    return mean


def _square(pose: Float64[np.ndarray, "3 4"]) -> Pose:
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
