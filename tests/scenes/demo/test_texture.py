"""Speckles on the demo scene's surfaces."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.scenes.demo.demo_parts import LAMP
from unmix_plugin.scenes.demo.scene import demo_cameras
from unmix_plugin.scenes.demo.shading import THINGS, solid_noise, speckled_things, trace


@pytest.fixture(scope="module")
def hits():
    """The same rays at the plain and at the speckled scene."""
    rays = demo_cameras(96, 4).image_rays(1)
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    return trace(origins, directions, LAMP[None]), trace(origins, directions, LAMP[None], speckled_things())


def test_speckles_change_abundances_and_nothing_else(hits):
    plain, speckled = hits
    assert (plain.is_hit == speckled.is_hit).all()
    assert (plain.specular == speckled.specular).all()
    assert_allclose(plain.diffuse.sum(axis=1), speckled.diffuse.sum(axis=1), rtol=1e-5)
    seen = plain.is_hit
    assert_allclose(speckled.abundances[seen].sum(axis=1), 1, atol=1e-6)
    assert speckled.abundances.min() >= 0
    assert (np.abs(plain.abundances - speckled.abundances)[seen].max(axis=1) > 0.2).mean() > 0.5


def test_every_thing_shows_both_of_its_materials(hits):
    _, speckled = hits
    shares = speckled.abundances[speckled.is_hit]
    assert ((shares > 0.7).mean(axis=0) > 0.005).all()
    assert len(speckled_things()) == len(THINGS)


def test_noise_is_smooth_and_differs_between_things():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32)
    values = solid_noise(points, 0)
    assert 0 <= values.min() < 0.35
    assert 0.65 < values.max() <= 1
    assert np.abs(solid_noise(points + np.float32(1e-4), 0) - values).max() < 0.02
    assert np.corrcoef(solid_noise(points, 1), values)[0, 1] < 0.2
