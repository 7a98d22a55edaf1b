import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.factories.demo_parts import APPLE, LAMP, PLACEMENTS, row
from unmix_plugin.scenes.demo import shading
from unmix_plugin.scenes.demo.scene import demo_cameras


def test_direct_light_follows_the_cosine_where_nothing_is_in_the_way():
    point = row(1.1, -0.3, 0)
    towards = LAMP - point[0]
    expected = shading.LAMP_IRRADIANCE * towards[2] / np.linalg.norm(towards)
    assert_allclose(shading.direct_light(point, row(0, 0, 1), LAMP[None], PLACEMENTS), expected, rtol=1e-5)


def test_a_point_behind_the_apple_lies_in_its_shadow():
    center = np.array(APPLE.placement.center)
    along = center - LAMP
    shadow = (LAMP + along * (LAMP[2] / -along[2])).astype(np.float32)
    assert np.hypot(shadow[0], shadow[1]) < 1.3, "the shadow's middle falls on the table"
    assert shading.direct_light(shadow[None], row(0, 0, 1), LAMP[None], PLACEMENTS) == 0
    before_the_apple = shadow + 0.01 * (LAMP - shadow)
    assert shading.direct_light(shadow[None], row(0, 0, 1), before_the_apple[None], PLACEMENTS) > 0


def test_a_highlight_seen_head_on_is_the_fresnel_reflectance_over_four_squared_roughness():
    # Eye, lamp and normal coincide: D = 1 / (pi a^2), both Smith terms 1, cosines 1.
    normal = LAMP[None] / np.linalg.norm(LAMP)
    got = shading.coat_highlight(np.zeros((1, 3), np.float32), normal, normal, 0.2, tuple(LAMP.tolist()))
    assert_allclose(got, shading.COAT_REFLECTANCE / (4 * 0.2**2), rtol=1e-4)


@pytest.fixture(scope="module")
def views():
    """The same view of the plain and of the speckled scene, a ray a pixel."""
    cameras = demo_cameras(96, 4)
    return [
        shading.render_view(cameras, 1, 1, things) for things in (shading.THINGS, shading.speckled_things())
    ]


def test_speckles_change_abundances_and_nothing_else(views):
    plain, speckled = views
    assert (plain.alpha == speckled.alpha).all()
    assert (plain.specular == speckled.specular).all()
    assert_allclose(plain.diffuse.sum(axis=-1), speckled.diffuse.sum(axis=-1), rtol=1e-5)
    seen = plain.alpha > 0
    assert_allclose(speckled.abundances[seen].sum(axis=-1), 1, atol=1e-6)
    assert speckled.abundances.min() >= 0
    assert (np.abs(plain.abundances - speckled.abundances)[seen].max(axis=-1) > 0.2).mean() > 0.5
