"""Light as a display shows it."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.viewer.layers.painting import VIEW_TRANSFORMS, to_display

greys = torch.logspace(-3, 2, 200)[:, None].expand(-1, 3)


def test_the_srgb_transform_is_srgb_up_to_white_and_white_beyond():
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    assert_close(to_display(light, 0.0, 1.0, "srgb"), linear_to_srgb(light))
    assert_close(to_display(light + 1, 0.0, 1.0, "srgb"), torch.ones(50, 3), atol=1e-6, rtol=0)


@given(st.floats(-4, 4))
def test_a_stop_of_exposure_doubles_the_light(stops):
    light = torch.tensor([[0.01, 0.02, 0.03]])
    assert_close(to_display(light, stops, 1.0, "agx"), to_display(light * 2**stops, 0.0, 1.0, "agx"))


@pytest.mark.parametrize("transform", list(VIEW_TRANSFORMS))
def test_more_light_is_never_darker_and_grey_stays_grey(transform):
    shown = to_display(greys, 0.0, 1.0, transform)
    assert (shown.diff(dim=0) >= -1e-6).all()
    assert (shown.amax(dim=1) - shown.amin(dim=1)).max() < 1e-3
    assert float(shown.min()) >= 0
    assert float(shown.max()) <= 1


def test_agx_shows_middle_grey_in_the_middle_and_tells_highlights_apart():
    middle = to_display(torch.full((1, 3), 0.18), 0.0, 1.0, "agx")
    assert float(middle.mean()) == pytest.approx(0.5, abs=0.01)
    bright = to_display(torch.tensor([[1.0], [2.0], [4.0]]).expand(-1, 3), 0.0, 1.0, "agx")[:, 0]
    assert bright.diff().min() > 0.03


def test_agx_lets_a_bright_colour_fade_towards_white():
    dim, bright = to_display(torch.tensor([[0.2, 0.0, 0.0], [16.0, 0.0, 0.0]]), 0.0, 1.0, "agx")
    assert float(dim[1] / dim[0]) < 0.5
    assert float(bright[1] / bright[0]) > 0.6


def test_gamma_lifts_the_dark_and_leaves_black_and_white():
    shown = to_display(torch.tensor([[0.0, 0.2, 1.0]]), 0.0, 2.0, "srgb")[0]
    plain = to_display(torch.tensor([[0.0, 0.2, 1.0]]), 0.0, 1.0, "srgb")[0]
    assert_close(shown[[0, 2]], plain[[0, 2]])
    assert float(shown[1]) == pytest.approx(float(plain[1]) ** 0.5)
