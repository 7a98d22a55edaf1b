"""Between a browser's camera and ours: conversions undo each other, nothing absurd gets in; paths of cameras."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.views import ring, some_pose
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.run_views import up_direction
from unmix_plugin.viewer.view_cameras import ViewPose, beside, camera_of, path_poses, pose_from, pose_of

components = st.floats(-1, 1, allow_nan=False)


def sent(wxyz, position, fov, aspect) -> Any:
    """A camera as a browser sends it."""
    width = round(1000 * aspect) if math.isfinite(aspect) else None
    return SimpleNamespace(wxyz=wxyz, position=position, fov=fov, image_height=1000, image_width=width)


quaternions = st.tuples(components, components, components, components).filter(lambda q: math.hypot(*q) > 0.1)


@given(quaternions, st.floats(0.2, 2.5), st.floats(0.3, 3.0))
def test_a_pose_survives_the_way_to_a_camera_and_back(wxyz, fov, aspect):
    pose = pose_from(sent(wxyz, (0.3, -2.0, 1.5), fov, aspect))
    back = pose_of(camera_of(pose, 240))
    assert abs(np.dot(back.wxyz, pose.wxyz)) == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(back.position, pose.position, rtol=1e-6)
    assert back.fov == pytest.approx(pose.fov, rel=1e-5)
    assert back.aspect == pytest.approx(pose.aspect, rel=0.02)


def test_a_browser_looking_along_its_z_is_a_camera_looking_along_minus_z():
    camera = camera_of(ViewPose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -3.0), math.radians(60), 1.0), 3)
    middle = camera.image_rays(0).directions[4]
    assert_close(middle, torch.tensor([0.0, 0.0, 1.0]))
    above = camera.image_rays(0).directions[1]
    assert above[1] < 0  # OpenCV: y points down, so what is above has smaller y
    wide = camera_of(ViewPose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.radians(90), 2.0), 100)
    assert (wide.width, wide.height) == (200, 100)
    assert wide.focal_px[0].tolist() == pytest.approx([50, 50])  # the field of view spans the height


SOUND = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov": 1.0, "aspect": 1.0}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("wxyz", wxyz) for wxyz in ((math.nan, 0, 0, 1), (0, 0, 0, 0), (1, 0, 0), ("x", 0, 0, 0))),
        *(("position", place) for place in ((math.inf, 0, 0), (0, 1e9, 0), (0, 0), (0, None, 0))),
        *(("fov", math.nan), ("aspect", math.nan), ("aspect", 0.0)),
    ],
)
def test_a_camera_that_is_none_is_refused(name, value):
    with pytest.raises(ConfigError, match="the browser sent a camera"):
        pose_from(sent(**{**SOUND, name: value}))


@pytest.mark.parametrize(("fov", "aspect", "expected"), [(100.0, 1e6, 10), (-5.0, 1e-3, 0.1)])
def test_absurd_fields_of_view_and_shapes_are_brought_within_bounds(fov, aspect, expected):
    pose = pose_from(sent((1, 0, 0, 0), (0, 0, 0), fov, aspect))
    assert 0 < pose.fov < math.pi
    assert pose.aspect == expected


@given(st.integers(1, 100_000), st.floats(0.1, 10))
def test_a_picture_never_has_more_pixels_than_allowed_nor_none(height, aspect):
    camera = camera_of(
        ViewPose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, aspect), height, largest_pixels=5000
    )
    assert 1 <= camera.width * camera.height <= 5000


def test_up_is_the_axis_that_cameras_hold_upright_and_z_where_they_look_down_whatever_their_pictures_have_on_top():
    assert up_direction(ring(8)) == (0.0, 0.0, 1.0)
    poses = torch.eye(4)[None, :3].repeat(6, 1, 1)
    poses[::2, :2, :2] *= -1  # flight lines there and back
    for chosen in (poses, poses[::2]):
        assert up_direction(replace(ring(len(chosen)), camera_to_world=chosen)) == (0.0, 0.0, 1.0)


def test_a_path_goes_smoothly_through_its_key_frames_in_their_order_and_needs_two():
    keys = [some_pose(index) for index in (0, 2, 1, 3)]
    poses = path_poses(keys, 31)
    assert len(poses) == 31
    for index, key in enumerate(keys):
        pose = poses[10 * index]
        np.testing.assert_allclose(pose.position, key.position, atol=1e-6)
        assert abs(np.dot(pose.wxyz, key.wxyz)) == pytest.approx(1, abs=1e-9)
        assert pose.fov == pytest.approx(key.fov)
    positions = np.array([pose.position for pose in path_poses([some_pose(i) for i in range(4)], 301)])
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert np.abs(np.diff(speeds)).max() < 0.02 * speeds.max()
    for few in ([], keys[:1]):
        with pytest.raises(ConfigError, match="at least two key frames"):
            path_poses(few, 10)


def test_a_page_starts_beside_a_camera_and_further_back_but_stays_in_a_room():
    camera, box = ring(8)[0], SceneBox(torch.tensor([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]]))
    start = beside(camera, box, (0.0, 0.0, 1.0))
    before, after = (one.camera_to_world[0].double().numpy() for one in (camera, start))
    assert np.linalg.norm(after[:, 3]) == pytest.approx(1.25 * np.linalg.norm(before[:, 3]), rel=0.05)
    cosine = after[:2, 3] @ before[:2, 3] / np.linalg.norm(after[:2, 3]) / np.linalg.norm(before[:2, 3])
    assert 5 < math.degrees(math.acos(cosine)) < 15
    np.testing.assert_allclose(after[:, :3].T @ after[:, :3], np.eye(3), atol=1e-6)
    room = SceneBox(torch.tensor([[-9.0] * 3, [9.0] * 3]))
    assert beside(camera, room, (0.0, 0.0, 1.0)) is camera
