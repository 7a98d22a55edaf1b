"""A ball, matt or glossy, seen from a ring of cameras, and what its pictures show of it."""

import numpy as np
import torch

from tests.factories.scenes import ball_alpha, cameras_of, ring_poses
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.scenes.geometry.carving import carve_box
from unmix_plugin.scenes.geometry.lighting import local_log_brightness

BOX = SceneBox(torch.tensor([[-1.0, -1.2, -0.9], [1.1, 1.0, 1.0]]))
SIDE, FOCAL = 40, 60.0


def make_cameras(poses: list[np.ndarray], distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)) -> Cameras:
    return cameras_of(poses, SIDE, SIDE, FOCAL, distortion)


def ball_matter(poses: list[np.ndarray], radius: float) -> list[np.ndarray]:
    return [ball_alpha(pose, radius, SIDE, SIDE, FOCAL) > 0 for pose in poses]


RADIUS = 0.6
LAMP = np.array([0.8, 0.3, 0.52])


ABOVE = np.array([0.0, 0.14, 0.99])


def ball_brightness(pose: np.ndarray, lamp: np.ndarray, gloss: float = 0.0) -> np.ndarray:
    """A ball in the light of a far lamp (unit direction in the world), and how strongly it mirrors that; 0 beside
    it."""
    steps = np.arange(SIDE) + 0.5 - SIDE / 2
    x, y = np.meshgrid(steps / FOCAL, -steps / FOCAL)
    directions = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origin = pose[:3, 3]
    along = -(directions @ origin)
    beside = origin @ origin - along**2
    distance = along - np.sqrt(np.maximum(RADIUS**2 - beside, 0))
    normals = (origin + distance[..., None] * directions) / RADIUS
    mirrored = directions - 2 * (directions * normals).sum(axis=-1, keepdims=True) * normals
    seen = 0.1 + np.maximum(normals @ lamp, 0) + gloss * np.maximum(mirrored @ lamp, 0) ** 4
    return np.where(beside < RADIUS**2, seen, 0.0)


def ball_views(
    follows_camera: bool,
    noise: float = 0.0,
    log_gains: np.ndarray | None = None,
    place: np.ndarray = LAMP,
    gloss: float = 0.0,
):
    """Cameras, brightness and hull of a ball, as `seen_places` takes them."""
    poses = ring_poses(16)
    generator = np.random.default_rng(0)
    images = []
    for index, pose in enumerate(poses):
        lamp = pose[:3, :3] @ place if follows_camera else place
        seen = ball_brightness(pose, lamp, gloss) * np.exp(noise * generator.normal(size=(SIDE, SIDE)))
        seen *= 1.0 if log_gains is None else np.exp(log_gains[index])
        images.append(local_log_brightness(torch.from_numpy(seen).float()))
    cameras = make_cameras(poses)
    return cameras, images, carve_box(cameras, ball_matter(poses, RADIUS), BOX, 32), BOX
