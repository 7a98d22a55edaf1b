import json

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.feature import SIFT

from tests.factories.files import present
from tests.factories.ground_views import (
    FOCAL,
    HEIGHT,
    SLOPE,
    WIDTH,
    flight_cameras,
    flight_poses,
    ground_views,
    strip_cameras,
)
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.lighting import judge_exposure
from unmix_plugin.scenes.geometry.matched_points import find_matched_points
from unmix_plugin.scenes.geometry.views import Views
from unmix_plugin.scenes.reading.loader import load_scene


def views_of(cameras, pictures=None, valid=None):
    """What the cameras see of the ground, or other pictures."""
    pictures = ground_views(cameras) if pictures is None else pictures
    return Views(cameras, lambda view, part: pictures[view][part], valid)


def above_ground(places):
    return places[:, 2] - SLOPE * places[:, 0]


@pytest.mark.parametrize("cameras", [flight_cameras(flight_poses()), strip_cameras()])
def test_matched_places_lie_on_the_ground_at_the_depths_of_their_cameras(cameras):
    found = present(find_matched_points(views_of(cameras)))
    assert above_ground(found.places).abs().quantile(0.9) < 0.05
    assert found.are_equally_far
    if cameras.is_line_camera(0):
        return
    for view in found.views.unique().tolist():
        of_view = found.views == view
        _, depths = cameras.project(found.places[of_view], view)
        assert torch.allclose(depths, found.depths[of_view], rtol=1e-3)


def test_places_stay_where_they_are_in_views_thinned_out_and_beside_pixels_that_are_not_valid(monkeypatch):
    cameras = flight_cameras(flight_poses())
    views = ground_views(cameras)
    for view in views:
        view[::31, ::29], view[150:, 160:] = np.nan, np.inf
    found = present(find_matched_points(views_of(cameras, views)))
    assert above_ground(found.places).abs().quantile(0.9) < 0.1
    monkeypatch.setattr("unmix_plugin.scenes.geometry.matched_points.LONGEST_SIDE_PX", WIDTH // 2)
    found = present(find_matched_points(views_of(cameras)))
    assert above_ground(found.places).mean().abs() < 0.02


def test_what_masks_leave_out_is_no_feature_and_does_not_tell_exposures():
    """Beside the mask exposures differ, as of an instrument's own parts in another light."""
    cameras = flight_cameras(flight_poses(16))
    gains = np.exp(np.random.default_rng(2).normal(size=16) * 0.3).astype(np.float32)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, WIDTH * 2 // 5 :] = False
    views = ground_views(cameras)
    for view, gain in zip(views, gains, strict=True):
        view[~valid] *= gain
    everything = present(find_matched_points(views_of(cameras, views)))
    assert judge_exposure(cameras, everything.places, everything.seen_by(16)) == "per-view"
    valid[::31, ::29] = False  # dead pixels spoil no feature
    found = present(find_matched_points(views_of(cameras, views, lambda _: valid)))
    assert judge_exposure(cameras, found.places, found.seen_by(16)) == "fixed"
    for end in (0, 1):
        for view in found.pairs[:, end].unique().tolist():
            coords, _ = cameras.project(found.places[found.pairs[:, end] == view], view)
            assert float(coords[:, 0].max()) < WIDTH * 2 // 5 - 7.5
    assert find_matched_points(views_of(cameras, views, lambda _: valid & False)) is None


def test_features_of_a_view_are_looked_for_once_and_anew_where_a_pixel_changes(monkeypatch):
    sought, detect = [], SIFT.detect_and_extract
    monkeypatch.setattr(SIFT, "detect_and_extract", lambda *args: (sought.append(1), detect(*args)))
    cameras = flight_cameras(flight_poses())[[0, 1]]
    pictures = ground_views(cameras)
    first = find_matched_points(views_of(cameras, pictures))
    count = len(sought)
    again = find_matched_points(views_of(cameras, pictures))
    assert len(sought) == count
    assert torch.equal(present(again).places, present(first).places)
    pictures[0][5, 5] += 0.01
    find_matched_points(views_of(cameras, pictures))
    assert len(sought) == count + 1


def test_views_that_share_nothing_show_one_colour_or_stand_at_one_place_have_no_matched_places():
    cameras = flight_cameras(flight_poses())
    unrelated = [np.random.default_rng(view).random((HEIGHT, WIDTH, 1), np.float32) for view in range(5)]
    plain = [np.full((HEIGHT, WIDTH, 1), 0.5, np.float32)] * 5
    assert find_matched_points(views_of(cameras, unrelated)) is None
    assert find_matched_points(views_of(cameras, plain)) is None
    turning = flight_cameras(flight_poses(5, spacing=0.0, sway=0.1))
    assert find_matched_points(views_of(turning)) is None


@pytest.mark.parametrize(("spread", "light"), [(0.0, "fixed"), (0.15, "per-view")])
def test_exposures_that_differ_are_told_by_matched_places(spread, light):
    cameras = flight_cameras(flight_poses(16))
    gains = np.exp(np.random.default_rng(2).normal(size=16) * spread).astype(np.float32)
    views = [view * gain for view, gain in zip(ground_views(cameras), gains, strict=True)]
    found = present(find_matched_points(views_of(cameras, views)))
    assert judge_exposure(cameras, found.places, found.seen_by(16)) == light


@pytest.mark.parametrize("count", [5, 12])
def test_the_box_of_a_flight_lies_on_the_ground_and_holds_all_of_it_that_is_seen(count):
    cameras = flight_cameras(flight_poses(count))
    points = find_matched_points(views_of(cameras))
    box = find_bounds(cameras, None, points)
    for index in range(len(cameras)):
        rays = cameras.image_rays(index)
        heights = rays.origins[:, 2] - SLOPE * rays.origins[:, 0]
        away = heights / (SLOPE * rays.directions[:, 0] - rays.directions[:, 2])
        assert box.contains(rays.origins + away[:, None] * rays.directions).float().mean() > 0.99
    low, high = box.aabb[:, 2].tolist()
    assert -0.6 < low < -0.1
    assert 0.1 < high < 0.6


def test_a_flight_is_read_as_a_bounded_scene_on_the_ground_by_what_its_masks_leave(tmp_path, monkeypatch):
    asked = []

    def find(views):
        asked.append(views.valid(0))
        return find_matched_points(views)

    monkeypatch.setattr("unmix_plugin.scenes.reading.model_space.find_matched_points", find)
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:20, :30] = False
    Image.fromarray(valid).save(tmp_path / "mask.png")
    cameras = flight_cameras(flight_poses())
    frames = []
    for index, (pose, view) in enumerate(zip(flight_poses(), ground_views(cameras), strict=True)):
        for band in (0, 1):
            np.save(tmp_path / f"{index}_{band}.npy", (0.2 + 0.4 * view * (band + 1)).clip(0, 1))
            frame = {"hyperspectral_file_path": f"{index}_{band}.npy", "mask_path": "mask.png"}
            own = {"sensor": f"lens {band}", "bands": [band], "transform_matrix": pose.tolist()}
            frames.append(frame | own)
    content = {"wavelengths": [500, 600], "fl_x": FOCAL, "frames": frames}
    content["test_filenames"] = [frame["hyperspectral_file_path"] for frame in frames[4:6]]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(tmp_path)
    assert np.array_equal(asked[0], valid)
    assert not scene.is_unbounded
    low, high = scene.normalisation.to_world(scene.scene_box.aabb.double().numpy())[:, 2]
    assert -0.6 < low < 0.0 < high < 0.6
