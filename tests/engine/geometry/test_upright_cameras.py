"""Cameras of built-in scenes: upright, and as wide as asked."""

import numpy as np
import torch
from torch.testing import assert_close

from unmix_plugin.engine.geometry.camera_paths import upright_cameras


def test_cameras_look_along_the_view_are_level_and_see_the_angle():
    generator = np.random.default_rng(0)
    backward = generator.normal(size=(5, 3))
    backward /= np.linalg.norm(backward, axis=1, keepdims=True)
    cameras = upright_cameras(generator.normal(size=(5, 3)), backward, 40, np.deg2rad(60.0))
    right, up, back = cameras.camera_to_world[:, :, :3].unbind(2)
    assert_close(back, torch.tensor(backward, dtype=torch.float32))
    assert right[:, 2].abs().max() < 1e-6
    assert (up[:, 2] > 0).all()
    assert_close(torch.linalg.cross(right, up), back)
    assert_close(torch.atan(cameras.width / 2 / cameras.focal_px), torch.full((5, 2), np.deg2rad(30.0)))
