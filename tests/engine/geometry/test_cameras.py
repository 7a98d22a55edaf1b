"""Cameras: rays and projections undo each other, axes and pixels are where the conventions say."""

import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.engine.geometry.cameras import Cameras, distort, undistort

WIDTH, HEIGHT = 64, 48


def make_cameras(count: int = 3, distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)) -> Cameras:
    generator = torch.Generator().manual_seed(count)
    rotations = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator))[0]
    rotations = rotations * torch.linalg.det(rotations)[:, None, None]
    positions = torch.randn(count, 3, 1, generator=generator)
    return Cameras(
        camera_to_world=torch.cat([rotations, positions], dim=-1),
        focal_px=torch.tensor([[70.0, 66.0]]).repeat(count, 1) + torch.arange(count)[:, None],
        center_px=torch.tensor([[31.0, 25.5]]).repeat(count, 1),
        distortion=torch.tensor([distortion]).repeat(count, 1),
        width=WIDTH,
        height=HEIGHT,
    )


places = st.tuples(st.floats(0.0, WIDTH, width=32), st.floats(0.0, HEIGHT, width=32))
pixels = st.lists(places, min_size=1, max_size=8)
terms = (st.floats(-0.2, 0.2), st.floats(-0.05, 0.05), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01))
lenses = st.tuples(*terms) | st.tuples(*terms, st.floats(-0.03, 0.03), st.floats(-0.02, 0.02))


@given(pixels, lenses, st.integers(0, 2), st.floats(0.1, 50.0))
def test_projecting_a_point_of_a_ray_gives_the_pixel_back(coords, lens, index, distance):
    cameras = make_cameras(distortion=lens)
    pixel_coords = torch.tensor(coords)
    rays = cameras.generate_rays(torch.full((len(coords),), index), pixel_coords)
    projected, depths = cameras.project(rays.origins + distance * rays.directions, index)
    assert_close(projected, pixel_coords, atol=2e-3, rtol=0)
    assert (depths > 0).all()


@given(st.floats(-0.8, 0.8), st.floats(-0.2, 0.2), st.integers(0, 2))
def test_a_point_that_no_ray_meets_is_not_projected_into_the_image(k1, k2, index):
    cameras = make_cameras(distortion=(k1, k2, 0.0, 0.0))
    towards = torch.randn(200, 3, generator=torch.Generator().manual_seed(index))
    points = cameras.camera_to_world[index, :, 3] + towards
    projected, depths = cameras.project(points, index)
    inside = (depths > 0) & ((projected >= 0) & (projected < torch.tensor([WIDTH, HEIGHT]))).all(dim=-1)
    rays = cameras.generate_rays(torch.full((int(inside.sum()),), index), projected[inside])
    towards = torch.nn.functional.normalize(towards[inside], dim=-1)
    assert ((towards * rays.directions).sum(dim=-1) > 0.999).all()


@given(pixels, lenses)
def test_directions_are_unit_and_origins_are_the_camera_positions(coords, lens):
    cameras = make_cameras(distortion=lens)
    indices = torch.arange(len(coords)) % 3
    rays = cameras.generate_rays(indices, torch.tensor(coords))
    assert_close(rays.directions.norm(dim=-1), torch.ones(len(coords)), atol=1e-5, rtol=0)
    assert torch.equal(rays.origins, cameras.camera_to_world[indices, :, 3])
    assert torch.equal(rays.camera_indices, indices)


def test_offsets_from_the_optical_axis_know_no_pixels():
    cameras = make_cameras()
    rays = cameras.generate_rays(torch.zeros(1, dtype=torch.int64), torch.tensor([[3.0, 2.0]]))
    finer = cameras.resized(4 * WIDTH, 4 * HEIGHT)
    same = finer.generate_rays(torch.zeros(1, dtype=torch.int64), torch.tensor([[12.0, 8.0]]))
    assert rays.offsets is not None
    assert_close(rays.offsets, (torch.tensor([[3.0, 2.0]]) - cameras.center_px[:1]) / cameras.focal_px[:1])
    assert_close(rays.offsets, same.offsets)


@given(lenses, st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_undistortion_inverts_distortion_to_rounding_in_double(lens, x, y):
    coefficients = torch.tensor(lens, dtype=torch.float64)
    coords = torch.tensor([[x, y]], dtype=torch.float64)
    assert_close(undistort(distort(coords, coefficients), coefficients), coords, atol=1e-10, rtol=0)


def test_distortion_agrees_with_the_opencv_formula_at_a_worked_point():
    # by hand for x = 0.3, y = -0.2, r2 = 0.13
    coefficients = torch.tensor([0.1, 0.02, 0.003, -0.004, 0.5, -0.7]).double()
    bent = distort(torch.tensor([[0.3, -0.2]], dtype=torch.float64), coefficients)
    radial = 1 + 0.1 * 0.13 + 0.02 * 0.13**2 + 0.5 * 0.13**3 - 0.7 * 0.13**4
    expected_x = 0.3 * radial + 2 * 0.003 * 0.3 * -0.2 - 0.004 * (0.13 + 2 * 0.09)
    expected_y = -0.2 * radial + 2 * -0.004 * 0.3 * -0.2 + 0.003 * (0.13 + 2 * 0.04)
    assert_close(bent, torch.tensor([[expected_x, expected_y]], dtype=torch.float64), atol=1e-7, rtol=0)


LENS = torch.full((1, 2), 50.0), torch.tensor([[32.0, 24.0]]), torch.zeros(1, 4)
CAMERA = Cameras(torch.eye(3, 4)[None], *LENS, WIDTH, HEIGHT)


def test_axes_are_opengl():
    coords = torch.tensor([[32.0, 24], [52.0, 24], [32.0, 4]])
    middle = CAMERA.generate_rays(torch.zeros(3, dtype=torch.int64), coords)
    assert_close(middle.directions[0], torch.tensor([0.0, 0.0, -1.0]))
    assert middle.directions[1, 0] > 0  # a pixel to the right lies at +x
    assert middle.directions[2, 1] > 0  # a pixel further up lies at +y


def test_depth_is_measured_along_the_axis_negative_behind_and_finite_on_the_plane():
    points = torch.tensor([[1.0, 2.0, -3.0], [0.0, 0.0, 4.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    projected, depths = CAMERA.project(points, 0)
    assert_close(depths, torch.tensor([3.0, -4.0, 0.0, 0.0]))
    assert torch.isfinite(projected).all()


def test_image_rays_run_row_after_row_through_pixel_centres_or_another_part_of_a_pixel():
    cameras = make_cameras()
    rays = cameras.image_rays(1)
    assert len(rays) == WIDTH * HEIGHT
    row, column = 5, 17
    expected = cameras.generate_rays(torch.tensor([1]), torch.tensor([[column + 0.5, row + 0.5]]))
    assert_close(rays.directions[row * WIDTH + column], expected.directions[0])
    assert (rays.camera_indices == 1).all()
    rays = cameras.image_rays(0, subpixel_offset=(0.25, 1.0))
    projected, _ = cameras.project(rays.origins + rays.directions, 0)
    assert_close(projected[WIDTH + 2], torch.tensor([2.25, 2.0]), atol=1e-3, rtol=0)


def test_json_gives_back_the_same_bits():
    cameras = make_cameras(distortion=(0.1, -0.02, 0.003, 0.1 / 3))
    again = Cameras.from_json(json.loads(json.dumps(cameras.to_json())))
    for name in ("camera_to_world", "focal_px", "center_px", "distortion"):
        assert torch.equal(getattr(again, name), getattr(cameras, name)), name
    assert (again.width, again.height, again.is_distorted) == (WIDTH, HEIGHT, True)
    assert not make_cameras().is_distorted


@pytest.mark.parametrize(("row", "column"), [(0, 0), (2, 1), (1, 2)])
def test_a_pose_that_is_no_rotation_is_refused(row, column):
    written = make_cameras(3).to_json()
    written["camera_to_world"][1][row][column] += 0.1
    with pytest.raises(ValueError, match="rotations"):
        Cameras.from_json(written)
    mirrored = make_cameras(3).to_json()
    mirrored["camera_to_world"][2][0][:3] = [-value for value in mirrored["camera_to_world"][2][0][:3]]
    with pytest.raises(ValueError, match="rotations"):
        Cameras.from_json(mirrored)


def cameras_of_two_sizes() -> Cameras:
    cameras = make_cameras(3)
    parts = (cameras.camera_to_world, cameras.focal_px, cameras.center_px, cameras.distortion)
    return Cameras.of_sizes(*parts, sizes=[(64, 48), (16, 12), (64, 48)])


def test_images_may_differ_in_size_and_cameras_come_in_the_order_asked_for():
    cameras = cameras_of_two_sizes()
    assert (cameras.width, cameras.height) == (64, 48)
    assert [cameras.size(index) for index in range(3)] == [(64, 48), (16, 12), (64, 48)]
    assert [len(cameras.image_rays(index)) for index in range(3)] == [3072, 192, 3072]
    small = cameras[1]
    assert (small.width, small.height, small.sizes) == (16, 12, None)
    for index, expected in ((1, [1]), (slice(1, 3), [1, 2]), ([2, 0], [2, 0]), (-1, [2])):
        chosen = cameras[index]
        assert [chosen.size(place) for place in range(len(chosen))] == [cameras.size(one) for one in expected]
        assert torch.equal(chosen.focal_px, cameras.focal_px[expected])
        assert torch.equal(chosen.camera_to_world, cameras.camera_to_world[expected])
    assert cameras[[0, 2]].sizes is None
    assert cameras[1:].sizes == ((16, 12), (64, 48))
    assert len(cameras[3:]) == 0


def test_sizes_survive_a_file_and_wrong_ones_are_refused():
    written = cameras_of_two_sizes().to_json()
    assert Cameras.from_json(json.loads(json.dumps(written))).sizes == ((64, 48), (16, 12), (64, 48))
    assert "sizes" not in make_cameras().to_json()
    for sizes in ([[64, 48]], [[64, 48], [16, 0], [64, 48]], [[64, 48], [16], [64, 48]]):
        with pytest.raises(ValueError, match=r"pixels|sizes"):
            Cameras.from_json({**written, "sizes": sizes})


def test_cameras_brought_to_one_size_see_the_same_height_of_the_scene():
    cameras = cameras_of_two_sizes()
    alike = cameras.one_size()
    assert [alike.size(index) for index in range(3)] == [(64, 48)] * 3
    for x, y in ((0.0, 0.0), (16.0, 12.0), (5.5, 2.0)):
        before = cameras.generate_rays(torch.tensor([1]), torch.tensor([[x, y]]))
        after = alike.generate_rays(torch.tensor([1]), torch.tensor([[4 * x, 4 * y]]))
        assert_close(after.directions, before.directions)
