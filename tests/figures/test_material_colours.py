"""Colours of materials: near their own, told apart, visible."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.figures.plotting import distinct_colours, own_colours
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import srgb_to_linear

BANDS = Bands.of(np.linspace(400, 700, 31))


def luminance(srgb):
    """Relative luminance of sRGB colours, [0, 1]."""
    return srgb_to_linear(torch.from_numpy(srgb)).numpy() @ [0.2126, 0.7152, 0.0722]


def least_difference(colours):
    """Smallest distance of two colours in sRGB."""
    distances = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    return (distances + 9 * np.eye(len(colours))).min()


@pytest.mark.parametrize(("count", "least"), [(8, 0.15), (26, 0.12), (100, 0.05), (255, 0.04)])
def test_colours_are_told_apart_even_if_all_materials_look_the_same(count, least):
    colours = distinct_colours(np.full((count, 3), 0.45))
    assert colours.shape == (count, 3)
    assert least_difference(colours) > least
    assert colours.min() >= 0
    assert colours.max() <= 1


@settings(max_examples=20)
@given(st.lists(st.tuples(*[st.floats(0, 1)] * 3), min_size=2, max_size=10))
def test_colours_differ_and_stand_out_from_white_paper_and_black_text(own):
    colours = distinct_colours(np.array(own))
    assert least_difference(colours) > 0.1
    assert luminance(colours).max() < 0.68
    assert luminance(colours).min() > 0.055


def test_colours_that_are_told_apart_already_stay():
    own = np.array([[0.8, 0.2, 0.2], [0.2, 0.3, 0.8], [0.2, 0.65, 0.3]])
    np.testing.assert_allclose(distinct_colours(own), own, atol=0.03)


def test_colours_are_the_same_each_time():
    own = np.random.default_rng(0).random((12, 3))
    np.testing.assert_array_equal(distinct_colours(own), distinct_colours(own))


def test_a_materials_own_colour_is_that_of_its_spectrum():
    wavelengths = torch.from_numpy(BANDS.centers_nm.copy())
    white, black = torch.ones(31), torch.zeros(31)
    red, blue = (wavelengths > 600).float(), (wavelengths < 480).float()
    colours = own_colours(torch.stack([white, black, red, blue]), BANDS)
    np.testing.assert_allclose(colours[0], 1.0, atol=1e-6)
    np.testing.assert_allclose(colours[1], 0.0, atol=1e-6)
    assert colours[2].argmax() == 0
    assert colours[3].argmax() == 2


def test_no_materials_need_no_colours():
    assert distinct_colours(np.zeros((0, 3))).shape == (0, 3)
