from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.factories.ball_views import BOX, FOCAL, SIDE, ball_matter, make_cameras
from tests.factories.scenes import ball_alpha, cameras_of, look_at, make_scene, ring_poses, set_frame
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import rotation_matrix
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.doctor import check_masks
from unmix_plugin.scenes.evidence import AlphaEvidence
from unmix_plugin.scenes.geometry import carving
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.carving import carve, carve_box, carve_by_masks, share_contradicted
from unmix_plugin.scenes.geometry.footprints import PixelView
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene


def centres(cells: int) -> np.ndarray:
    steps = (np.arange(cells) + 0.5) / cells
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
    return BOX.aabb[0].numpy() + grid * BOX.size.numpy()


def seen_by(cameras: Cameras, index: int, cells: int, margin_px: float, nearest: float) -> np.ndarray:
    """Cells whose centre lies in a view widened by a margin, beyond a depth."""
    pixels, depths = cameras.project(torch.from_numpy(centres(cells).reshape(-1, 3)).float(), index)
    inside = ((pixels >= -margin_px) & (pixels <= SIDE + margin_px)).all(-1) & (depths > nearest)
    return inside.reshape(cells, cells, cells).numpy()


@settings(max_examples=15)
@given(st.integers(2, 12), st.floats(0.2, 0.7), st.integers(5, 36))
def test_the_hull_holds_every_cell_that_a_ball_touches_and_not_many_more(views, radius, cells):
    poses = ring_poses(views)
    hull = carve_box(make_cameras(poses), ball_matter(poses, radius), BOX, cells)
    distances = np.linalg.norm(centres(cells), axis=-1)
    assert hull[distances < radius].all()
    if views == 12 and cells >= 20:
        assert not hull[distances > radius + 0.45].any()


def test_cells_are_indexed_x_y_z_from_the_smallest_corner():
    poses = ring_poses(8)
    ball_at = np.array([0.5, 0.0, 0.0])
    moved = [pose.copy() for pose in poses]
    for pose in moved:
        pose[:3, 3] -= ball_at  # the ball stays in the images of cameras that move with it
    cameras = make_cameras(poses)
    hull = carve_box(cameras, [ball_alpha(pose, 0.25, SIDE, SIDE, FOCAL) > 0 for pose in moved], BOX, 32)
    middle = centres(32)[hull].mean(axis=0)
    np.testing.assert_allclose(middle, ball_at, atol=0.1)


def test_refining_finds_exactly_what_testing_every_cell_finds(monkeypatch):
    poses = ring_poses(6)
    cameras, foreground = make_cameras(poses), ball_matter(poses, 0.5)
    refined = carve_box(cameras, foreground, BOX, 64)
    monkeypatch.setattr("unmix_plugin.scenes.geometry.carving.COARSEST_CELLS", 64)
    direct = carve_box(cameras, foreground, BOX, 64)
    assert (refined != direct).mean() < 1e-4  # rectangles of children may stick out by rounding


@pytest.mark.parametrize("lens", [(-0.3, 0.1, 0.0, 0.0), (0.2, 0.0, 0.01, -0.01)])
def test_the_hull_holds_the_ball_through_a_bent_lens_too(lens):
    cameras, radius = make_cameras(ring_poses(8), lens), 0.5
    foreground = []
    for index in range(8):
        hits = []
        for x, y in product((0.1, 0.5, 0.9), repeat=2):
            bundle = cameras.image_rays(index, (x, y))
            along = -(bundle.directions * bundle.origins).sum(-1)
            hits.append((bundle.origins**2).sum(-1) - along**2 < radius**2)
        foreground.append(torch.stack(hits).any(dim=0).reshape(SIDE, SIDE).numpy())
    hull = carve_box(cameras, foreground, BOX, 40)
    inside = np.linalg.norm(centres(40), axis=-1) < radius
    assert hull[inside].all()
    assert hull.mean() < 4.0 * inside.mean()


def test_without_alpha_exactly_the_cells_in_front_of_some_camera_stay():
    cameras = make_cameras([look_at(np.array([0.0, -2.0, 0.2]), np.array([0.3, 0.0, 0.0]))])
    kept = carve_box(cameras, None, BOX, 24)
    seen, near = seen_by(cameras, 0, 24, 0, 0.1), seen_by(cameras, 0, 24, 6, -0.2)
    assert kept[seen].all()
    assert not kept[~near].any()
    assert 0 < seen.mean() < near.mean() < 1


def test_pixels_that_a_mask_ignores_count_as_matter(folder):
    mask = np.where(np.arange(20) < 10, 255, 0).astype(np.uint8)[None].repeat(16, 0)
    Image.fromarray(mask).save(folder.root / "mask.png")
    scene = load_scene(folder.edit(set_frame(1, mask_path="mask.png")).root)
    table = PixelTable(scene, torch.device("cpu"), scene.train_indices)
    masked, other, *_ = AlphaEvidence(table, True).foreground()
    assert masked[:, 10:].all()
    for view, shown in ((1, masked[:, :10]), (2, other)):
        alpha = scene.alpha(view)
        assert alpha is not None
        assert np.array_equal(shown, alpha[:, : shown.shape[1]] > 0)


def test_the_box_of_a_room_seen_from_one_side_holds_what_all_cameras_look_at():
    positions = [np.array([x, -3.6, z]) for x in (-0.6, 0.0, 0.6) for z in (-0.5, 0.5)]
    cameras = make_cameras([look_at(position, np.zeros(3)) for position in positions])
    box = find_bounds(cameras, None)
    assert box.contains(torch.tensor(list(product((-1.0, 1.0), repeat=3)))).all()
    assert (box.size < 3.2).all()
    assert not box.contains(torch.tensor(np.stack(positions)).float()).any()


def test_parallel_cameras_get_a_box_in_front_of_them_that_they_share():
    positions = [np.array([x, -3.0, 0.0]) for x in (-0.5, 0.0, 0.5)]
    cameras = make_cameras([look_at(p, p + np.array([0.0, 1.0, 0.0])) for p in positions])
    middle = find_bounds(cameras, None).aabb.mean(dim=0)
    assert middle[1] > -2.0
    pixels, depths = cameras.project(middle[None], 1)
    assert (depths > 0).all()
    assert ((pixels >= 0) & (pixels <= SIDE)).all()


@pytest.mark.parametrize("count", [1, 2])
def test_a_single_camera_or_two_at_one_place_still_get_a_box(count):
    poses = [look_at(np.array([0.0, -2.0, 0.0]), np.array([0.1 * i, 0.0, 0.0])) for i in range(count)]
    box = find_bounds(make_cameras(poses), None)
    assert torch.isfinite(box.aabb).all()
    assert (box.size > 0.1).all()


@pytest.mark.parametrize("has_alpha", [True, False])
def test_the_model_box_is_centred_and_its_longest_edge_is_two(tmp_path, has_alpha):
    away = np.array([500.0, -20.0, 3.0])  # far from the world's origin
    folder = make_scene(tmp_path / "scene", frames=7, alpha=has_alpha)
    for index, pose in enumerate(ring_poses(7)):
        pose[:3, 3] += away
        folder.edit(set_frame(index, transform_matrix=pose.tolist()))
    scene = load_scene(folder.root)
    low, high = scene.scene_box.aabb.numpy()
    np.testing.assert_allclose(low, -high, atol=1e-6)
    assert (high - low).max() == pytest.approx(2.0)
    world = scene.normalisation.to_world(scene.scene_box.aabb.double().numpy())
    assert ((world[0] < away) & (world[1] > away)).all()


def test_cells_that_too_few_views_see_are_carved_and_the_others_stay():
    poses = [look_at(np.array([x, -2.0, 0.2]), np.array([x, 0.0, 0.0])) for x in (-0.6, 0.0, 0.6)]
    cameras = make_cameras(poses)
    foreground = [np.ones((SIDE, SIDE), bool)] * 3
    kept = [carve_box(cameras, foreground, BOX, 24, fewest_views=n) for n in (1, 2, 3)]
    count = np.sum([seen_by(cameras, index, 24, 0, 0.1) for index in range(3)], axis=0)
    for n, cells in enumerate(kept, start=1):
        assert cells[count >= n].all()
    assert kept[0].sum() > kept[1].sum() > kept[2].sum() > 0
    assert ((kept[0] >= kept[1]) & (kept[1] >= kept[2])).all()


def test_views_of_two_sizes_carve_and_bound_the_same_ball():
    poses, radius = ring_poses(8), 0.5
    sides = [SIDE if index % 2 else SIDE // 2 for index in range(8)]
    whole, factors = make_cameras(poses), torch.tensor(sides)[:, None] / SIDE
    lens = whole.focal_px * factors, whole.center_px * factors, whole.distortion
    mixed = Cameras.of_sizes(whole.camera_to_world, *lens, [(side, side) for side in sides])
    seen = zip(poses, sides, strict=True)
    foreground = [ball_alpha(pose, radius, side, side, FOCAL * side / SIDE) > 0 for pose, side in seen]
    hull = carve_box(mixed, foreground, BOX, 32)
    distances = np.linalg.norm(centres(32), axis=-1)
    assert hull[distances < radius].all()
    assert not hull[distances > 1.0].any()
    box = find_bounds(mixed, foreground).aabb.numpy()
    assert (box[0] < -radius + 0.05).all()
    assert (box[1] > radius - 0.05).all()
    assert np.abs(box).max() < 1.4  # pixels of the smaller views are wide


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("demo") / "scene"
    make_demo_scene(folder, size=64, bands=4, views=16)
    return load_scene(folder)


def boxed(scene: Scene) -> Scene:
    """A scene in a box, for other cameras and masks."""
    return replace(scene, scene_box=BOX, is_unbounded=False)


def test_a_hole_in_one_mask_does_not_carve_what_all_other_views_see(demo):
    poses = ring_poses(12)
    cameras, foreground = make_cameras(poses), ball_matter(poses, 0.5)
    true = carve_box(cameras, foreground, BOX, 32)
    assert carve(boxed(demo), 32, foreground, cameras).sum() <= true.sum()
    foreground[3] = foreground[3].copy()
    foreground[3][14:26, 14:26] = False
    spoilt, kept = carve_box(cameras, foreground, BOX, 32), carve(boxed(demo), 32, foreground, cameras)
    assert (true & ~spoilt).sum() > 0.1 * true.sum()
    assert not (true & ~kept).any()
    assert kept.sum() < 1.6 * true.sum()


def test_where_many_views_look_through_what_the_others_see_more_must_agree(demo):
    """Leaves move between views; but no more than 0.3 of the views are asked to agree, if that is more than three."""
    poses = ring_poses(24)
    cameras, true = make_cameras(poses), ball_matter(poses, 0.5)

    def spoilt(num_views: int) -> list[np.ndarray]:
        masks = [mask.copy() for mask in true]
        for mask in masks[:num_views]:
            mask[14:26, 14:26] = False
        return masks

    scene, few = boxed(demo), carve_box(cameras, spoilt(5), BOX, 64, witnesses=2)
    enough = carve(scene, 64, spoilt(5), cameras)
    shares = [carving.share_explained(scene, hull, spoilt(5), cameras) for hull in (few, enough)]
    assert shares[0] < carving.MIN_EXPLAINED <= shares[1]
    most = carve_box(cameras, spoilt(20), BOX, 64, witnesses=6)
    assert (carve(scene, 64, spoilt(20), cameras) <= most).all()


def turned(scene: Scene, size: float) -> Scene:
    """The scene with cameras that look elsewhere, by so many radians along each axis."""
    poses = scene.cameras.camera_to_world.clone()
    steps = size * torch.randn(len(poses), 3, generator=torch.Generator().manual_seed(0))
    poses[:, :, :3] = rotation_matrix(steps) @ poses[:, :, :3]
    return replace(scene, cameras=replace(scene.cameras, camera_to_world=poses))


@pytest.mark.parametrize(("turn", "is_told"), [(0.0, False), (0.002, False), (0.1, True)])
def test_poses_that_are_off_by_several_pixels_are_told_and_right_ones_raise_no_alarm(demo, turn, is_told):
    alphas = [demo.alpha(index) for index in demo.train_indices]
    scene = turned(demo, turn)
    foreground = [alpha > 0 for alpha in alphas if alpha is not None]
    cameras = scene.cameras[list(scene.train_indices)]
    found = check_masks(share_contradicted(cameras, foreground, scene.scene_box))
    assert (None if found is None else found.code) == (Message.MASKS_CONTRADICT if is_told else None)
    assert found is None or found.values["share"] > 0.05


@pytest.mark.parametrize("focal_px", [FOCAL, 3 * FOCAL])
@pytest.mark.parametrize(("fewest_views", "witnesses"), [(1, 1), (5, 2)])
def test_a_view_is_asked_once_of_what_it_shows_all_over_and_the_hull_stays_the_same(
    focal_px, fewest_views, witnesses, monkeypatch
):
    poses = ring_poses(8)
    cameras = replace(make_cameras(poses), focal_px=torch.full((8, 2), float(focal_px)))
    foreground = [ball_alpha(pose, 0.6, SIDE, SIDE, focal_px) > 0 for pose in poses]
    judge, asked = PixelView.judge, []

    def counted(view, centres, half, near):
        asked.append(centres.shape[1])
        return judge(view, centres, half, near)

    monkeypatch.setattr(PixelView, "judge", counted)
    once = carve_box(cameras, foreground, BOX, 64, fewest_views, witnesses)
    number = sum(asked)
    asked.clear()
    monkeypatch.setattr(PixelView, "judge", lambda *args: replace(counted(*args), is_settled=None))
    np.testing.assert_array_equal(carve_box(cameras, foreground, BOX, 64, fewest_views, witnesses), once)
    assert once.any()
    assert number < 0.8 * sum(asked)


@pytest.mark.parametrize("turn", [0.0, 0.1])
def test_carving_tells_what_masks_contradict_as_asking_for_that_alone_does(demo, turn):
    scene = turned(demo, turn)
    foreground = [demo.alpha(index) > 0 for index in demo.train_indices]
    cameras = scene.cameras[list(scene.train_indices)]
    contradicted = carve_by_masks(cameras, foreground, scene.scene_box, 32)[1]
    assert contradicted == share_contradicted(cameras, foreground, scene.scene_box)
    assert (contradicted > 0.05) == (turn > 0)


def test_a_point_on_the_right_or_lower_edge_of_an_image_is_outside_as_everywhere():
    camera = cameras_of([np.eye(4)], 8, 8, 8.0)
    edges = torch.tensor([[-0.5, 0.0, -1.0], [0.0, 0.5, -1.0], [0.5, 0.0, -1.0], [0.0, -0.5, -1.0]])
    assert carving.count_views(camera, edges).tolist() == [1, 1, 0, 0]
