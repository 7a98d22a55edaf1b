"""Whether a light is told from one that moves with the camera, on a matt ball."""

import numpy as np
import pytest
import torch

from tests.scenes.geometry.test_carving import BOX, FOCAL, SIDE, ball_matter, make_cameras
from tests.scenes.scene_factory import ring_poses
from unmix_plugin.scenes.geometry.carving import carve_box
from unmix_plugin.scenes.geometry.lighting import (
    foretold_share,
    hull_places,
    light_moves,
    local_log_brightness,
)

RADIUS = 0.6
LAMP = np.array([0.8, 0.3, 0.52])


def ball_brightness(pose: np.ndarray, lamp: np.ndarray) -> np.ndarray:
    """A matt ball in the light of a far lamp (unit direction in the world); 0 beside it."""
    steps = np.arange(SIDE) + 0.5 - SIDE / 2
    x, y = np.meshgrid(steps / FOCAL, -steps / FOCAL)
    directions = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origin = pose[:3, 3]
    along = -(directions @ origin)
    beside = origin @ origin - along**2
    distance = along - np.sqrt(np.maximum(RADIUS**2 - beside, 0))
    normals = (origin + distance[..., None] * directions) / RADIUS
    return np.where(beside < RADIUS**2, 0.1 + np.maximum(normals @ lamp, 0), 0.0)


def foretold(follows_camera: bool, noise: float = 0.0) -> tuple[float, bool]:
    poses = ring_poses(16)
    generator = np.random.default_rng(0)
    images = []
    for pose in poses:
        lamp = pose[:3, :3] @ LAMP if follows_camera else LAMP
        seen = ball_brightness(pose, lamp) * np.exp(noise * generator.normal(size=(SIDE, SIDE)))
        spectra = torch.from_numpy(np.repeat(seen[..., None], 3, axis=-1)).float()
        images.append(local_log_brightness(spectra, torch.from_numpy(seen > 0)))
    cameras = make_cameras(poses)
    hull = carve_box(cameras, ball_matter(poses, RADIUS), BOX, 32)
    arguments = (cameras, images, hull, BOX)
    return foretold_share(*arguments), light_moves(*arguments)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_a_light_that_moves_with_the_camera_is_told_from_a_fixed_one(noise):
    moving, fixed = foretold(True, noise), foretold(False, noise)
    assert moving[0] > 0.1
    assert fixed[0] < 0.0
    assert (moving[1], fixed[1]) == (True, False)


def test_normals_of_a_hull_point_outwards():
    poses = ring_poses(12)
    hull = carve_box(make_cameras(poses), ball_matter(poses, RADIUS), BOX, 32)
    places = hull_places(hull, BOX)
    outwards = torch.nn.functional.normalize(places.positions, dim=-1)
    assert float((outwards * places.normals).sum(dim=-1).median()) > 0.9


def test_too_few_views_say_nothing():
    poses = ring_poses(6)
    blank = [np.zeros((SIDE, SIDE)) for _ in poses]
    hull = carve_box(make_cameras(poses), ball_matter(poses, RADIUS), BOX, 32)
    assert foretold_share(make_cameras(poses), blank, hull, BOX) == 0.0
    assert foretold_share(make_cameras(poses), blank, np.zeros((32, 32, 32), bool), BOX) == 0.0
