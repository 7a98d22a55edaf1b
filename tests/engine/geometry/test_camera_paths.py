"""Where cameras stand and look: paths are of real cameras, and the focus is where axes meet."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.cameras import BOX, around, cameras_at, in_front
from tests.factories.ground_views import flight_poses
from tests.factories.scenes import look_at, ring_poses
from unmix_plugin.engine.geometry.camera_paths import (
    focus_point,
    interpolated,
    meeting_point,
    orbit,
    upright_cameras,
)
from unmix_plugin.errors import ConfigError


def assert_rigid(cameras):
    rotations = cameras.camera_to_world[:, :, :3]
    assert_close(rotations.transpose(1, 2) @ rotations, torch.eye(3).expand_as(rotations), atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotations) > 0).all()


def seen_at(cameras, point):
    """Where each camera sees a point, (N, 2) pixels, and whether all have it in front."""
    seen = [cameras.project(torch.tensor([point]), index) for index in range(len(cameras))]
    return torch.cat([coords for coords, _ in seen]), all(bool(depth > 0) for _, depth in seen)


def test_an_orbit_goes_once_round_at_the_cameras_distance_and_looks_at_what_they_look_at():
    path = orbit(around(), BOX, 36)
    assert_rigid(path)
    positions = path.camera_to_world[:, :, 3].numpy()
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 4.0, atol=1e-3)
    np.testing.assert_allclose(positions[:, 2], positions[0, 2], atol=1e-3)
    turned = np.diff(np.unwrap(np.arctan2(positions[:, 1], positions[:, 0])))
    np.testing.assert_allclose(turned, 2 * np.pi / 36, atol=1e-4)
    coords, in_view = seen_at(path, [0.0, 0.0, 0.0])
    assert in_view
    torch.testing.assert_close(coords, torch.tensor([[20.0, 15.0]]).expand(36, 2), atol=0.05, rtol=0)


def test_the_horizon_of_an_orbit_is_level_even_where_cameras_look_down_unevenly():
    places = [4 * np.array([np.cos(a), np.sin(a), 0.2 + 0.1 * a]) for a in np.arange(6.0)]
    poses = [look_at(place, np.zeros(3)) for place in places]
    path = orbit(cameras_at(poses), BOX, 8)
    np.testing.assert_allclose(path.camera_to_world[:, 2, 0], 0.0, atol=1e-5)
    assert (path.camera_to_world[:, 2, 1] > 0).all()


def test_cameras_on_one_side_give_an_arc_over_that_side_to_and_fro():
    cameras = in_front()
    path = orbit(cameras, BOX, 40).camera_to_world[:, :, 3].numpy()
    assert (path[:, 1] < -2.5).all()
    given = cameras.camera_to_world[:, 0, 3]
    assert path[:, 0].min() == pytest.approx(float(given.min()), abs=0.05)
    assert path[:, 0].max() == pytest.approx(float(given.max()), abs=0.05)
    steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
    assert steps.max() < 0.15, "the last frame leads back to the first"


def test_one_camera_alone_and_cameras_that_look_straight_down_have_an_orbit_too():
    path = orbit(cameras_at([look_at(np.array([0.0, -3.0, 1.0]), np.zeros(3))]), BOX, 12)
    assert_rigid(path)
    assert 0.3 < np.ptp(path.camera_to_world[:, 0, 3].numpy()) < 2.0
    poses = [look_at(np.array([x, 0.01, 4.0]), np.array([x, 0.0, 0.0])) for x in (-0.5, 0.0, 0.5)]
    assert_rigid(orbit(cameras_at(poses), BOX, 12))


def test_a_path_meets_its_cameras_and_goes_on_smoothly():
    cameras = around(8)
    path = interpolated(cameras, BOX, 701)
    assert_rigid(path)
    poses, along = cameras.camera_to_world, path.camera_to_world
    torch.testing.assert_close(along[0], poses[0], atol=1e-5, rtol=0)
    for pose in poses:
        assert (along - pose).abs().amax(dim=(1, 2)).min() < 0.01
    steps = np.linalg.norm(np.diff(along[:, :, 3].numpy(), axis=0), axis=1)
    assert steps.max() < 4 * steps.mean()
    assert np.abs(np.diff(along[:, :, :3].numpy(), axis=0)).max() < 0.05


def test_a_path_bends_around_what_its_cameras_look_at():
    places = ([4.0, 0.1, 1.0], [-4.0, 0.1, 1.0], [-4.0, -0.4, 1.0])
    path = interpolated(cameras_at([look_at(np.array(place), np.zeros(3)) for place in places]), BOX, 60)
    assert np.linalg.norm(path.camera_to_world[:, :, 3], axis=1).min() > 3.8
    coords, in_view = seen_at(path, [0.0, 0.0, 0.0])
    assert in_view
    torch.testing.assert_close(coords, torch.tensor([[20.0, 15.0]]).expand(60, 2), atol=0.1, rtol=0)


def test_a_path_comes_no_nearer_and_goes_no_farther_than_its_cameras():
    angles, distances = np.arange(9) * 0.7, np.array([4.0, 4, 0.7, 0.7, 4, 0.7, 4, 4, 0.7])
    places = distances[:, None] * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    path = interpolated(cameras_at([look_at(place, np.zeros(3)) for place in places]), BOX, 301)
    away = path.camera_to_world[:, :, 3].norm(dim=1)
    assert float(away.min()) > 0.69
    assert float(away.max()) < 4.01


@pytest.mark.parametrize("target", [-0.1, 2.0])
def test_opposite_cameras_have_a_path_of_real_cameras(target):
    poses = [look_at(np.array([x, 0.0, 0.0]), np.array([target * x, 0.0, 0.0])) for x in (-3.0, 3.0)]
    path = interpolated(cameras_at(poses), BOX, 31)
    assert_rigid(path)
    assert bool(torch.isfinite(path.camera_to_world).all())


def test_the_nearest_camera_left_comes_next():
    angles = [0.0, 2.0, 1.0, 3.0]
    poses = [look_at(4 * np.array([np.cos(a), np.sin(a), 0.5]), np.zeros(3)) for a in angles]
    path = interpolated(cameras_at(poses), BOX, 50).camera_to_world[:, :, 3].numpy()
    turned = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    assert (np.diff(turned) > 0).all()
    assert turned[-1] - turned[0] == pytest.approx(3.0, abs=1e-3)


def test_a_path_needs_two_different_cameras():
    pose = look_at(np.array([3.0, 0.0, 0.0]), np.zeros(3))
    for poses in ([pose], [pose, pose]):
        with pytest.raises(ConfigError, match="at least two different ones; choose --cameras orbit"):
            interpolated(cameras_at(poses), BOX, 5)


def test_another_size_keeps_the_vertical_view_square_pixels_and_a_shifted_centre():
    cameras = around(2)
    larger = cameras.resized(200, 60)
    assert (larger.width, larger.height) == (200, 60)
    point = torch.tensor([[0.1, 0.2, 0.3]])
    before, after = cameras.project(point, 0)[0][0], larger.project(point, 0)[0][0]
    torch.testing.assert_close(after - torch.tensor([100.0, 30.0]), 2 * (before - torch.tensor([20.0, 15.0])))
    shifted = replace(around(1), center_px=torch.tensor([[23.0, 12.0]]))
    torch.testing.assert_close(shifted.resized(80, 60).center_px, torch.tensor([[46.0, 24.0]]))


def test_a_shrunk_camera_has_few_pixels_of_the_same_view():
    camera = around()[0]
    small = camera.shrunk(300)
    assert small.width * small.height == pytest.approx(300, rel=0.1)
    assert small.width / small.height == pytest.approx(camera.width / camera.height, rel=0.1)
    angles = [float(one.focal_px[0, 1]) / one.height for one in (small, camera)]
    assert angles[0] == pytest.approx(angles[1])
    assert camera.shrunk(camera.width * camera.height) is camera


def stacked(poses):
    return np.stack(poses)[:, :3]


@pytest.mark.parametrize("find", [focus_point, meeting_point])
def test_the_focus_is_where_all_axes_meet(find):
    target = np.array([0.3, -0.2, 0.5])
    poses = [look_at(np.array(p), target) for p in ((3.0, 0, 1), (0, 3.0, 2), (-2.0, -2.0, 0))]
    found = find(stacked(poses))
    assert found is not None
    np.testing.assert_allclose(found, target, atol=1e-5)


@pytest.mark.parametrize("find", [focus_point, meeting_point])
def test_parallel_and_outward_cameras_have_no_focus(find):
    parallel = [look_at(np.array([x, -3.0, 0.0]), np.array([x, 0.0, 0.0])) for x in (-0.5, 0.0, 0.5)]
    outward = [look_at(pose[:3, 3], 2.0 * pose[:3, 3]) for pose in ring_poses(6)]
    assert find(stacked(parallel)) is None
    assert find(stacked(outward)) is None


@pytest.mark.parametrize("count", [3, 5, 20])
def test_axes_of_a_flight_whose_camera_sways_do_not_meet(count):
    assert meeting_point(stacked(flight_poses(count))) is None


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
