"""Whether a light is distinguished from one that moves with the camera, on a matt ball."""

import numpy as np
import pytest
import torch

from tests.scenes.geometry.ball_views import BOX, RADIUS, SIDE, ball_matter, ball_views, make_cameras
from tests.scenes.scene_factory import ring_poses
from unmix_plugin.scenes.geometry.carving import carve_box
from unmix_plugin.scenes.geometry.lighting import (
    _foretold_share,
    _gain_spread,
    _view_gains,
    judge_light,
    seen_places,
)


def gain_spread(views):
    places, seen = seen_places(*views)
    followed = seen.isfinite().sum(dim=1) >= 4
    return _gain_spread(views[0], places.positions[followed], seen[followed])


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_a_light_that_moves_with_the_camera_is_told_from_a_fixed_one(noise):
    moving, fixed = ball_views(True, noise), ball_views(False, noise)
    assert _foretold_share(moving[0], *seen_places(*moving)) > 0.1
    assert _foretold_share(fixed[0], *seen_places(*fixed)) < 0.0
    assert (judge_light(*moving), judge_light(*fixed)) == ("camera", "fixed")


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_views_of_different_exposure_are_told_from_views_of_one(noise):
    log_gains = np.log(np.random.default_rng(1).uniform(0.8, 1.2, 16))
    views = ball_views(False, noise, log_gains)
    assert gain_spread(views) == pytest.approx(log_gains.std(), rel=0.5)
    assert judge_light(*views) == "per-view"


def test_gains_are_found_exactly_where_places_differ_by_nothing_else():
    generator = np.random.default_rng(0)
    log_gains = torch.from_numpy(generator.normal(size=8) * 0.2).float()
    seen = torch.from_numpy(generator.normal(size=(100, 1))).float() + log_gains
    seen[torch.from_numpy(generator.random((100, 8)) < 0.6)] = torch.nan
    found = _view_gains(seen)
    torch.testing.assert_close(found, log_gains - log_gains.mean(), atol=1e-4, rtol=0)
    seen[:, 3] = torch.nan
    assert _view_gains(seen).isnan().tolist() == [index == 3 for index in range(8)]


def test_few_views_of_different_exposure_are_left_alone():
    views = ball_views(False, log_gains=np.log(np.linspace(0.8, 1.2, 16)))
    few = (views[0][:10], views[1][:10], *views[2:])
    assert judge_light(*few) == "fixed"


def test_too_few_views_say_nothing():
    poses = ring_poses(6)
    blank = [np.zeros((SIDE, SIDE)) for _ in poses]
    hull = carve_box(make_cameras(poses), ball_matter(poses, RADIUS), BOX, 32)
    dark = (make_cameras(poses), [image * np.nan for image in blank])
    for shape in (hull, np.zeros((32, 32, 32), bool)):
        assert judge_light(*dark, shape, BOX) == "fixed"
