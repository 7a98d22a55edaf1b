"""Paths through key frames."""

import math

import numpy as np
import pytest
import torch

from tests.viewer.view_factory import some_pose
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.view_cameras import path_poses, path_views, rotation_matrix


def test_a_path_goes_through_its_key_frames_in_their_order():
    keys = [some_pose(index) for index in (0, 2, 1, 3)]
    poses = path_poses(keys, 31)
    assert len(poses) == 31
    for index, key in enumerate(keys):
        pose = poses[10 * index]
        np.testing.assert_allclose(pose.position, key.position, atol=1e-6)
        np.testing.assert_allclose(rotation_matrix(pose.wxyz), rotation_matrix(key.wxyz), atol=1e-6)
        assert pose.fov == pytest.approx(key.fov)


def test_a_path_is_smooth():
    positions = np.array([pose.position for pose in path_poses([some_pose(i) for i in range(4)], 301)])
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert np.abs(np.diff(speeds)).max() < 0.02 * speeds.max()


@pytest.mark.parametrize("count", [0, 1])
def test_a_path_needs_two_key_frames(count):
    with pytest.raises(ConfigError, match="at least two key frames"):
        path_poses([some_pose()] * count, 10)


def test_views_of_a_path_have_the_size_asked_for_and_keep_the_vertical_field_of_view():
    views = path_views([some_pose(0), some_pose(1)], 640, 360)
    assert [view.name for view in views] == ["path_0000", "path_0001"]
    for view in views:
        assert (view.camera.width, view.camera.height) == (640, 360)
        focal = 180 / math.tan(some_pose().fov / 2)
        torch.testing.assert_close(view.camera.focal_px, torch.full((1, 2), focal))
        assert view.camera.center_px.tolist() == [[320.0, 180.0]]
