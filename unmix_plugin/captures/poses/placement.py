"""Where a scene is placed: +z up, its middle in the origin, its cameras at most 1 away; recorded to be undone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.alignment import moved
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.engine.geometry.camera_paths import focus_point, meeting_point
from unmix_plugin.formats.ply import write_ply
from unmix_plugin.scenes.placement import Placement

POINTS_FILE = "points.ply"
"""Of a scene folder; its `ply_file_path`."""
LEAST_TURN_DEG = 10.0
"""Horizontal axes of cameras that span less than this do not tell the vertical."""
MOST_SWAY_DEG = 30.0
"""Between the axes of cameras that look down and their mean, about."""


@dataclass(frozen=True)
class PlacedPoses:
    """Poses in the world of a scene."""

    poses: PoseSet
    """In the scene's world; its offset is 0."""
    placement: Placement
    """From the source's world to the scene's."""
    notes: tuple[str, ...]
    """How up axis, middle and scale were found, one sentence each."""


def place_poses(poses: PoseSet, is_flight: bool = False) -> PlacedPoses:
    """Settle up axis, middle and scale of a scene.

    The up axis is the source's where it has one, otherwise the direction across which the cameras' horizontal axes lie,
    or the mean of their up vectors. The middle is where the cameras look, or that of the sparse points.

    Args:
        poses: In the source's world.
        is_flight: Whether cameras that all look one way look down.
    """
    stacked = np.stack([camera.camera_to_world for camera in poses.cameras.values()])
    up, how_up = _find_up(stacked, poses.up, is_flight)
    middle, how_middle = _find_middle(stacked, poses.points)
    reach = float(np.linalg.norm(stacked[:, :, 3] - middle, axis=1).max())
    scale = 1.0 / reach if reach > 0 else 1.0
    rotation = _turn_to_z(up)
    inner = Placement(rotation, -rotation @ middle, scale)
    cameras = {name: moved(camera, inner) for name, camera in poses.cameras.items()}
    points = None if poses.points is None else inner.to_scene(poses.points)
    how_large = [f"1 unit of the scene is {1.0 / scale:.6g} of the source"] if poses.has_world else []
    notes = (how_up, how_middle, *how_large)
    placed = replace(poses, cameras=cameras, points=points, offset=np.zeros(3), up=np.array([0.0, 0.0, 1.0]))
    return PlacedPoses(placed, replace(inner, offset=poses.offset), notes)


def write_points(folder: Path, poses: PoseSet) -> str | None:
    """Write the sparse points beside a scene's transforms.json; the name for `ply_file_path`, None without points.

    Args:
        poses: In the scene's world.
    Raises:
        RunError: the disk is full or refuses.
    """
    if poses.points is None or len(poses.points) == 0:
        return None
    columns = {axis: poses.points[:, index].astype(np.float32) for index, axis in enumerate("xyz")}
    if poses.colours is not None:
        columns |= {name: poses.colours[:, index] for index, name in enumerate(("red", "green", "blue"))}
    write_ply(
        folder / POINTS_FILE, columns, comments=["sparse points of structure from motion, scene coordinates"]
    )
    return POINTS_FILE


def _find_up(
    poses: Float64[np.ndarray, "N 3 4"], known: Float64[np.ndarray, "3"] | None, is_flight: bool
) -> tuple[Float64[np.ndarray, "3"], str]:
    if known is not None:
        return known, "up is the source's"
    back = poses[:, :, 2].mean(axis=0)
    if is_flight and np.linalg.norm(back) > np.cos(np.radians(MOST_SWAY_DEG)):
        return back / np.linalg.norm(back), "up is against where the cameras look, as they would in a flight"
    mean = poses[:, :, 1].mean(axis=0)
    _, singular, vt = np.linalg.svd(poses[:, :, 0], full_matrices=True)
    is_spread = len(singular) > 1 and singular[1] > np.sin(np.radians(LEAST_TURN_DEG)) * singular[0]
    vertical = vt[2] * (1.0 if vt[2] @ mean >= 0 else -1.0)
    if is_spread and vertical @ mean > 0.5 * np.linalg.norm(mean) > 0.05:
        return vertical, "up is square to the cameras' horizontal axes"
    if np.linalg.norm(mean) > 0.1:
        return mean / np.linalg.norm(mean), "up is the mean of the cameras' up vectors"
    return np.array([0.0, 0.0, 1.0]), "up is not to be told from the cameras: +z of the source is taken"


def _find_middle(
    poses: Float64[np.ndarray, "N 3 4"], points: Float64[np.ndarray, "P 3"] | None
) -> tuple[Float64[np.ndarray, "3"], str]:
    met, nearest = meeting_point(poses), focus_point(poses)
    if met is None and points is not None and len(points) > 0:
        return np.median(points, axis=0), (
            "the middle is that of the sparse points, as the cameras look at no one place"
        )
    if nearest is not None:
        return nearest, "the middle is the point nearest to all optical axes"
    return poses[:, :, 3].mean(axis=0), "the middle is that of the cameras"


def _turn_to_z(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation that takes a unit vector to +z."""
    axis, cosine = np.cross(up, (0.0, 0.0, 1.0)), float(up[2])
    if cosine < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
