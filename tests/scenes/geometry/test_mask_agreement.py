"""Masks that contradict each other are told from masks that fit together."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from unmix_plugin.engine.geometry.key_poses import rotation_matrix
from unmix_plugin.scenes import load_scene
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.geometry.carving import foreground_mask, mask_warning, share_explained
from unmix_plugin.scenes.scene import Scene


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("demo") / "scene"
    make_demo_scene(folder, size=64, bands=4, views=16)
    return load_scene(folder)


def masks(scene: Scene) -> list[np.ndarray]:
    return [foreground_mask(scene, index) for index in scene.train_indices]


def turned(scene: Scene, size: float) -> Scene:
    """The scene with cameras that look elsewhere, by so many radians along each axis."""
    poses = scene.cameras.camera_to_world.clone()
    steps = size * torch.randn(len(poses), 3, generator=torch.Generator().manual_seed(0))
    poses[:, :, :3] = rotation_matrix(steps) @ poses[:, :, :3]
    return replace(scene, cameras=replace(scene.cameras, camera_to_world=poses))


def test_right_poses_and_masks_raise_no_alarm(demo):
    assert mask_warning(demo, masks(demo)) is None
    assert mask_warning(turned(demo, 0.002), masks(demo)) is None


def test_poses_that_are_off_by_several_pixels_are_told(demo):
    warning = mask_warning(turned(demo, 0.1), masks(demo))
    assert warning is not None
    assert "contradict each other" in warning
    assert "--poses refine" in warning


def test_an_empty_hull_explains_nothing_and_a_full_one_all(demo):
    cameras = demo.cameras[list(demo.train_indices)]
    for fill, share in ((False, 0.0), (True, 1.0)):
        assert share_explained(demo, np.full((16, 16, 16), fill), masks(demo), cameras) == share
