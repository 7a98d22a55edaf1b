"""Line cameras: poses between key poses, rays row by row, and which row sees a point."""

import json
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix, rotation_vector

WIDTH, HEIGHT = 12, 40
angles = st.tuples(*[st.floats(-1.6, 1.6)] * 3)


def pose(turn: tuple[float, float, float], place: tuple[float, float, float]) -> torch.Tensor:
    return torch.cat([rotation_matrix(torch.tensor(turn)), torch.tensor(place)[:, None]], dim=1)


def keys(distortion: float = 0.0, p1: float = 0.0) -> Cameras:
    """A frame camera, and two line cameras that move and turn."""
    turns = (
        (0.1, 0.2, 0.3),
        (0.0, 0.0, 0.0),
        (0.0, 0.1, 0.0),
        (0.0, 0.1, 0.1),
        (0.3, 0.0, 0.0),
        (-0.3, 0.0, 0.0),
    )
    still = (0.0, 0.0, 4.0)
    places = still, (0.0, 1.5, 4.0), (0.2, 0.0, 4.1), (0.0, -1.5, 4.0), still, still
    poses = torch.stack(list(map(pose, turns, places)))
    heights = torch.tensor([0.5, 0.5, 15.0, 39.5, 0.0, 40.0])
    key_poses = KeyPoses(poses, heights, (1, 3, 2))
    middle = key_poses.at(torch.arange(3), torch.full((3,), HEIGHT / 2))
    lens = torch.tensor([distortion, 0.0, p1, 0.0]).repeat(3, 1)
    focal, center = torch.full((3, 2), 30.0), torch.tensor([[6.0, 20.0]]).repeat(3, 1)
    return Cameras(middle, focal, center, lens, WIDTH, HEIGHT, key_poses=key_poses)


@given(angles)
def test_the_vector_of_a_rotation_gives_it_back(turn):
    w = torch.tensor(turn, dtype=torch.float64)
    assert_close(rotation_vector(rotation_matrix(w)), w, atol=1e-9, rtol=0)
    assert_close(rotation_matrix(w) @ rotation_matrix(-w), torch.eye(3).double(), atol=1e-12, rtol=0)
    assert_close(rotation_matrix(1e-7 * w)[2, 1], 1e-7 * w[0], atol=1e-12, rtol=0)  # turns as the thumb says


@pytest.mark.parametrize("size", [0.0, 1e-5, 1e-3, 0.5])
def test_gradients_of_a_rotation_are_those_of_finite_differences(size):
    w = (size * torch.tensor([0.6, -0.3, 0.7], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(rotation_matrix, (w,), eps=1e-7, atol=1e-6)


@given(st.floats(0.0, 1.0), st.floats(-1.5, 1.5))
def test_between_two_key_poses_the_camera_turns_and_moves_evenly(share, angle):
    start, end = pose((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)), pose((0.0, 0.0, angle), (3.0, 2.0, -1.0))
    key_poses = KeyPoses(torch.stack([start, end]), torch.tensor([0.5, 8.5]), (2,))
    found = key_poses.at(torch.zeros(1, dtype=torch.int64), torch.tensor([0.5 + 8 * share]))[0]
    expected = pose((0.0, 0.0, share * angle), (1 + 2 * share, 2.0, 3 - 4 * share))
    assert_close(found, expected, atol=2e-6, rtol=0)


def test_each_camera_has_its_own_key_poses_and_a_frame_camera_one_for_all_rows():
    cameras = keys()
    assert cameras.key_poses is not None
    for index, first in ((0, 0), (1, 1), (2, 4)):
        y = cameras.key_poses.of(index).heights
        found = cameras.poses_at(torch.full((len(y),), index), y)
        assert_close(found, cameras.key_poses.poses[first : first + len(y)], atol=1e-6, rtol=0)
    still = cameras.poses_at(torch.zeros(5, dtype=torch.int64), torch.linspace(0, HEIGHT, 5))
    assert_close(still, cameras.key_poses.poses[:1].expand(5, 3, 4))
    assert [cameras.is_line_camera(index) for index in range(3)] == [False, True, True]


@pytest.mark.parametrize("p1", [0.0, 0.05])
def test_a_row_sees_only_its_own_line(p1):
    cameras = keys(p1=p1)
    rows = torch.arange(HEIGHT) + 0.5
    for x in (0.5, 11.5):
        pixels = torch.stack([torch.full_like(rows, x), rows], dim=1)
        rays = cameras.generate_rays(torch.ones(HEIGHT, dtype=torch.int64), pixels)
        poses = cameras.poses_at(rays.camera_indices, rows)
        local = torch.einsum("nji,nj->ni", poses[:, :, :3], rays.directions)
        expected = torch.nn.functional.normalize(torch.tensor([(x - 6.0) / 30.0, 0.0, -1.0]), dim=0)
        assert_close(local, expected.expand_as(local), atol=1e-6, rtol=0)
        assert_close(rays.origins, poses[:, :, 3])


@pytest.mark.parametrize(("distortion", "p1"), [(0.0, 0.0), (-0.1, 0.0), (-0.1, 0.02)])
@given(
    st.lists(st.tuples(st.floats(0.1, 11.9), st.floats(0.1, 39.9)), min_size=1, max_size=6), st.integers(0, 2)
)
def test_projecting_a_point_of_a_ray_gives_the_pixel_back(distortion, p1, coords, index):
    cameras, pixels = keys(distortion, p1), torch.tensor(coords)
    rays = cameras.generate_rays(torch.full((len(coords),), index), pixels)
    found, depths = cameras.project(rays.origins + 3.0 * rays.directions, index)
    assert_close(found, pixels, atol=5e-3, rtol=0)
    assert (depths > 0).all()


def test_what_no_row_passes_over_is_not_seen():
    _, depths = keys().project(torch.tensor([[0.0, 9.0, 0.0], [0.0, 0.0, 9.0], [0.0, 0.0, 0.0]]), 1)
    assert (depths > 0).tolist() == [False, False, True]


@pytest.mark.parametrize("index", [0, 1, 2], ids=["frame", "sweep", "nod"])
@pytest.mark.parametrize(
    ("left", "top", "width", "height"), [(0, 7, WIDTH, 12), (4, 17, 1, 1), (3, 30, 5, 10)]
)
def test_a_part_of_an_image_has_the_rays_of_its_pixels(index, left, top, width, height):
    camera = keys(-0.1)[index]
    part = camera.crop(left, top, width, height)
    assert (part.width, part.height) == (width, height)
    pixels = torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)[top : top + height, left : left + width]
    whole, found = camera.image_rays(0)[pixels.flatten()], part.image_rays(0)
    assert_close(found.directions, whole.directions, atol=1e-6, rtol=0)
    assert_close(found.origins, whole.origins, atol=1e-6, rtol=0)
    assert found.axes is not None
    assert_close(found.axes, whole.axes, atol=1e-6, rtol=0)


def test_other_sizes_see_the_same_directions():
    camera = keys()[1]
    whole, row, column = camera.image_rays(0), 17, 4
    larger = camera.resized(3 * WIDTH, 3 * HEIGHT).image_rays(0)
    middle = (3 * row + 1) * 3 * WIDTH + 3 * column + 1
    assert_close(larger.directions[middle], whole.directions[row * WIDTH + column], atol=1e-5, rtol=0)
    assert_close(larger.origins[middle], whole.origins[row * WIDTH + column], atol=1e-5, rtol=0)


def test_json_gives_back_the_same_bits_and_frame_cameras_have_none():
    cameras = keys()
    back = Cameras.from_json(json.loads(json.dumps(cameras.to_json())))
    found: Any = back.key_poses
    expected: Any = cameras.key_poses
    assert torch.equal(found.poses, expected.poses)
    assert torch.equal(found.heights, expected.heights)
    assert found.counts == expected.counts
    assert cameras[0].key_poses is None
    assert "key_poses" not in cameras[0].to_json()
    assert cameras[[2, 0]].key_poses is not None


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("counts", [1, 3]),
        ("counts", [1, 3, 1]),
        ("heights", [0, 5, 4, 7, 0, 1]),
        ("heights", [0.0, math.nan] * 3),
        ("poses", [[[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]] * 6),
    ],
)
def test_damaged_key_poses_are_refused(part, value):
    values = keys().to_json()
    values["key_poses"][part] = value
    with pytest.raises((ValueError, RuntimeError)):
        Cameras.from_json(values)
