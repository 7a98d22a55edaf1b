import numpy as np
import pytest
import torch

from tests.factories.ball_views import ABOVE, BOX, RADIUS, SIDE, ball_matter, ball_views, make_cameras
from tests.factories.scenes import ring_poses
from unmix_plugin.scenes.geometry.carving import carve_box
from unmix_plugin.scenes.geometry.lighting import judge_light, view_gains


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_lights_that_move_with_the_camera_or_differ_in_exposure_are_told_from_a_fixed_one(noise):
    log_gains = np.log(np.random.default_rng(1).uniform(0.8, 1.2, 16))
    views = (ball_views(True, noise), ball_views(False, noise), ball_views(False, noise, log_gains))
    assert [judge_light(*each) for each in views] == ["camera", "fixed", "per-view"]


def test_what_a_glossy_surface_mirrors_of_a_lamp_above_is_no_light_that_moves():
    assert judge_light(*ball_views(False, place=ABOVE, gloss=1.0)) == "fixed"
    assert judge_light(*ball_views(True, gloss=1.0)) == "camera"


def test_gains_are_found_exactly_where_places_differ_by_nothing_else():
    generator = np.random.default_rng(0)
    log_gains = torch.from_numpy(generator.normal(size=8) * 0.2).float()
    seen = torch.from_numpy(generator.normal(size=(100, 1))).float() + log_gains
    seen[torch.from_numpy(generator.random((100, 8)) < 0.6)] = torch.nan
    found = view_gains(seen)
    torch.testing.assert_close(found, log_gains - log_gains.mean(), atol=1e-4, rtol=0)
    seen[:, 3] = torch.nan
    assert view_gains(seen).isnan().tolist() == [index == 3 for index in range(8)]


def test_too_few_views_or_dark_ones_say_nothing():
    views = ball_views(False, log_gains=np.log(np.linspace(0.8, 1.2, 16)))
    assert judge_light(views[0][:10], views[1][:10], *views[2:]) == "fixed"
    cameras, dark = make_cameras(ring_poses(6)), [np.full((SIDE, SIDE), np.nan)] * 6
    hull = carve_box(cameras, ball_matter(ring_poses(6), RADIUS), BOX, 32)
    assert judge_light(cameras, dark, hull, BOX) == "fixed"
    assert judge_light(cameras, dark, hull & False, BOX) == "fixed"
