"""A sloping ground with a fine pattern, seen from a flight whose camera sways."""

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial.transform import Rotation

from tests.factories.scenes import cameras_of
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses

WIDTH, HEIGHT, FOCAL = 240, 192, 220.0
ALTITUDE, SLOPE, EXTENT = 2.0, 0.1, 6.0
"""Of the flight over the ground at the origin; how steep the ground is along x; edge of the pattern."""


def flight_poses(count: int = 5, spacing: float = 0.35, sway: float = 0.05) -> list[np.ndarray]:
    """Cameras in a line along y that look down, each turned a little."""
    rng = np.random.default_rng(0)
    poses = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, sway, 3)).as_matrix()
        pose[:3, 3] = 0.0, (number - (count - 1) / 2) * spacing, ALTITUDE
        poses.append(pose)
    return poses


def flight_cameras(poses: list[np.ndarray]) -> Cameras:
    return cameras_of(poses, WIDTH, HEIGHT, FOCAL)


def strip_cameras(count: int = 3) -> Cameras:
    """Line cameras side by side, each moved along y while it takes its rows, the first row last."""
    middles, ends = [], []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", 0.1 * (number % 2)).as_matrix()
        pose[:3, 3] = 0.5 * (number - (count - 1) / 2), 0.0, ALTITUDE
        middles.append(pose)
        for y in (1.0, -1.0):
            end = pose.copy()
            end[1, 3] = y
            ends.append(end)
    frames = flight_cameras(middles)
    heights = torch.tensor([0.5, HEIGHT - 0.5]).repeat(count)
    keys = KeyPoses(torch.from_numpy(np.stack(ends)[:, :3]).float(), heights, (2,) * count)
    lenses = (frames.focal_px, frames.center_px, frames.distortion)
    return Cameras.of_sizes(frames.camera_to_world, *lenses, [(WIDTH, HEIGHT)] * count, keys)


def ground_views(cameras: Cameras) -> list[np.ndarray]:
    """What each camera sees, (H, W, 1)."""
    rng = np.random.default_rng(1)
    pattern = sum(ndimage.zoom(rng.random((size, size)), 1200 / size, order=1) for size in (60, 150, 300))
    views = []
    for index in range(len(cameras)):
        rays = cameras.image_rays(index)
        origins, directions = rays.origins.numpy(), rays.directions.numpy()
        heights = origins[:, 2] - SLOPE * origins[:, 0]
        away = heights / (SLOPE * directions[:, 0] - directions[:, 2])
        places = (origins + away[:, None] * directions)[:, :2] / EXTENT + 0.5
        seen = ndimage.map_coordinates(pattern / 3, 1200 * places.T[::-1], order=1, mode="wrap")
        views.append(seen.reshape(HEIGHT, WIDTH, 1).astype(np.float32))
    return views
