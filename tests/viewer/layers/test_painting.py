"""What a user has chosen stays within bounds, whatever a browser sends; light as a display shows it."""

import math
from dataclasses import fields, replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.viewer.view_factory import make_aids
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.spectral.maps.indices import _MAX_LENGTH
from unmix_plugin.viewer.layers.painting import (
    BACKGROUNDS,
    COLOUR_MAPS,
    EXPOSURE_BOUNDS,
    GAMMA_BOUNDS,
    VIEW_TRANSFORMS,
    LayerSettings,
    _to_display,
)

names = st.sampled_from([entry.name for entry in fields(LayerSettings)])
anything = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=6,
)


@given(names, anything)
def test_settings_are_always_valid(name, value):
    settings = LayerSettings().changed(name, value)
    assert isinstance(settings.layer, str)
    assert EXPOSURE_BOUNDS[0] <= settings.exposure_ev <= EXPOSURE_BOUNDS[1]
    assert GAMMA_BOUNDS[0] <= settings.gamma <= GAMMA_BOUNDS[1]
    assert settings.background in BACKGROUNDS
    assert settings.colour_map in COLOUR_MAPS
    assert settings.view_transform in VIEW_TRANSFORMS
    assert all(math.isfinite(value) for value in (settings.wavelength_nm, *settings.false_colour_nm))
    assert 0 <= settings.endmember < 255
    assert len(settings.index) <= 1000
    assert settings.value_range is None or settings.value_range[0] < settings.value_range[1]


def test_sound_values_are_taken_as_they_are():
    settings = LayerSettings()
    for name, value in {
        "layer": "pca",
        "wavelength_nm": 610.0,
        "false_colour_nm": (700.0, 600.0, 500.0),
        "endmember": 4,
        "index": "(r800-r670)/(r800+r670)",
        "colour_map": "magma",
        "value_range": (-1.0, 2.0),
        "exposure_ev": -2.5,
        "gamma": 2.2,
        "view_transform": "agx",
        "background": "black",
    }.items():
        settings = settings.changed(name, value)
        assert getattr(settings, name) == value
    assert settings.changed("value_range", None).value_range is None


def test_a_range_that_is_none_leaves_the_one_before():
    settings = LayerSettings().changed("value_range", (0.0, 2.0))
    for nonsense in ((2.0, 1.0), (math.nan, 1.0), "ab", 3, (1.0,)):
        assert settings.changed("value_range", nonsense).value_range == (0.0, 2.0)


def test_a_formula_that_is_too_long_stays_too_long_rather_than_becoming_another_one():
    cut = LayerSettings().changed("index", "r600" + " " * 900 + "+r650" * 400)
    assert len(cut.index) == 1000 > _MAX_LENGTH
    kept = LayerSettings().changed("index", "r600" + " " * 2000 + "/ r650")
    assert kept.index == "r600 / r650"
    assert kept.changed("index", 3.0).index == "r600 / r650"


def test_what_is_remembered_survives_another_thread_that_forgets_it(source):
    class Forgetful(dict):
        def __setitem__(self, key, value):
            super().__setitem__(key, value)
            self.clear()  # as another thread may, at just this moment

    aids = replace(make_aids(source), _kept=Forgetful())
    with source.borrowed() as scene:
        materials = scene.materials
    assert aids.colours_of(materials).shape == (len(materials.names), 3)


greys = torch.logspace(-3, 2, 200)[:, None].expand(-1, 3)


def test_the_srgb_transform_is_srgb_up_to_white_and_white_beyond():
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    assert_close(_to_display(light, 0.0, 1.0, "srgb"), linear_to_srgb(light))
    assert_close(_to_display(light + 1, 0.0, 1.0, "srgb"), torch.ones(50, 3), atol=1e-6, rtol=0)


@given(st.floats(-4, 4))
def test_a_stop_of_exposure_doubles_the_light(stops):
    light = torch.tensor([[0.01, 0.02, 0.03]])
    assert_close(_to_display(light, stops, 1.0, "agx"), _to_display(light * 2**stops, 0.0, 1.0, "agx"))


@pytest.mark.parametrize("transform", list(VIEW_TRANSFORMS))
def test_more_light_is_never_darker_and_grey_stays_grey(transform):
    shown = _to_display(greys, 0.0, 1.0, transform)
    assert (shown.diff(dim=0) >= -1e-6).all()
    assert (shown.amax(dim=1) - shown.amin(dim=1)).max() < 1e-3
    assert float(shown.min()) >= 0
    assert float(shown.max()) <= 1


def test_agx_shows_middle_grey_in_the_middle_and_tells_highlights_apart():
    middle = _to_display(torch.full((1, 3), 0.18), 0.0, 1.0, "agx")
    assert float(middle.mean()) == pytest.approx(0.5, abs=0.01)
    bright = _to_display(torch.tensor([[1.0], [2.0], [4.0]]).expand(-1, 3), 0.0, 1.0, "agx")[:, 0]
    assert bright.diff().min() > 0.03


def test_agx_lets_a_bright_colour_fade_towards_white():
    dim, bright = _to_display(torch.tensor([[0.2, 0.0, 0.0], [16.0, 0.0, 0.0]]), 0.0, 1.0, "agx")
    assert float(dim[1] / dim[0]) < 0.5
    assert float(bright[1] / bright[0]) > 0.6


def test_gamma_lifts_the_dark_and_leaves_black_and_white():
    shown = _to_display(torch.tensor([[0.0, 0.2, 1.0]]), 0.0, 2.0, "srgb")[0]
    plain = _to_display(torch.tensor([[0.0, 0.2, 1.0]]), 0.0, 1.0, "srgb")[0]
    assert_close(shown[[0, 2]], plain[[0, 2]])
    assert float(shown[1]) == pytest.approx(float(plain[1]) ** 0.5)
