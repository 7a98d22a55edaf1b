"""L*a*b* and CIEDE2000 against their published values."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power
from unmix_plugin.spectral.colour.difference import ciede2000, lab_to_srgb, reflectance_to_lab, srgb_to_lab

VISIBLE = Bands.of(np.linspace(380, 780, 81))

SHARMA_PAIRS = [
    ([50.0, 2.6772, -79.7751], [50.0, 0.0, -82.7485], 2.0425),
    ([50.0, -1.0, 2.0], [50.0, 0.0, 0.0], 2.3669),
    ([50.0, 2.49, -0.001], [50.0, -2.49, 0.0011], 7.2195),
    ([60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644),
    ([90.9257, -0.5406, -0.9208], [88.6381, -0.8985, -0.7239], 1.5381),
    ([2.0776, 0.0795, -1.1350], [0.9033, -0.0636, -0.5514], 0.9082),
]
"""Sharma, Wu and Dalal 2005, table 1."""


@pytest.mark.parametrize(("first", "second", "expected"), SHARMA_PAIRS)
def test_differences_are_those_of_the_published_pairs(first, second, expected):
    assert ciede2000(np.array(first), np.array(second)) == pytest.approx(expected, abs=1e-4)
    assert ciede2000(np.array(second), np.array(first)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("srgb", "lab"),
    [
        ([1, 1, 1], [100, 0, 0]),
        ([1, 0, 0], [53.24, 80.09, 67.20]),
        ([0, 0, 1], [32.30, 79.19, -107.86]),
        ([0, 0, 0], [0, 0, 0]),
    ],
)
def test_srgb_primaries_have_their_known_lab(srgb, lab):
    """Lindbloom's calculator, D65."""
    assert_allclose(srgb_to_lab(np.array(srgb, dtype=float)), lab, atol=0.1)


@settings(deadline=None)
@given(st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_lab_leads_back_to_srgb(srgb):
    assert_allclose(lab_to_srgb(srgb_to_lab(np.array(srgb))), srgb, atol=1e-6)


@pytest.mark.parametrize("name", ["D65", "A", "FL11"])
def test_grey_surfaces_are_grey_to_an_eye_adapted_to_any_light(name):
    greys = np.array([[1.0], [0.184]]) * np.ones(81)
    lab = reflectance_to_lab(greys, illuminant_power(name, VISIBLE), VISIBLE)
    assert_allclose(lab[0], [100, 0, 0], atol=1e-9)
    assert_allclose(lab[1], [50, 0, 0], atol=0.1)
    assert_allclose(reflectance_to_lab(greys, 0.2 * illuminant_power(name, VISIBLE), VISIBLE), lab, atol=1e-9)
