import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, xyz_matrix
from unmix_plugin.spectral.colour.difference import (
    ciede2000,
    lab_to_srgb,
    metameric_pairs,
    reflectance_to_lab,
    srgb_to_lab,
)

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


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3))
def test_srgb_has_its_known_lab_and_lab_leads_back(srgb):
    """Lindbloom's calculator, D65."""
    colours = np.array([[1.0, 1, 1], [1, 0, 0], [0, 0, 1], [0, 0, 0]])
    known = [[100, 0, 0], [53.24, 80.09, 67.20], [32.30, 79.19, -107.86], [0, 0, 0]]
    assert_allclose(srgb_to_lab(colours), known, atol=0.1)
    assert_allclose(lab_to_srgb(srgb_to_lab(np.array(srgb))), srgb, atol=1e-6)


@pytest.mark.parametrize("name", ["D65", "A", "FL11"])
def test_grey_surfaces_are_grey_to_an_eye_adapted_to_any_light(name):
    greys = np.array([[1.0], [0.184]]) * np.ones(81)
    lab = reflectance_to_lab(greys, illuminant_power(name, VISIBLE), VISIBLE)
    assert_allclose(lab[0], [100, 0, 0], atol=1e-9)
    assert_allclose(lab[1], [50, 0, 0], atol=0.1)
    assert_allclose(reflectance_to_lab(greys, 0.2 * illuminant_power(name, VISIBLE), VISIBLE), lab, atol=1e-9)


BANDS = Bands.of(np.linspace(400, 700, 31))
LIGHTS = np.stack([illuminant_power(name, BANDS) for name in ("D65", "A")])


def metamer_of(reflectance: np.ndarray, strength: float) -> np.ndarray:
    """Another reflectance of the same colour in the first light: what only the second light shows is added."""
    in_first, in_second = ((light[:, None] * xyz_matrix(BANDS, torch.float64).numpy()).T for light in LIGHTS)
    invisible = np.linalg.svd(in_first)[2][3:]
    added = (invisible @ in_second[0]) @ invisible
    return reflectance + strength * added / np.abs(added).max()


def surfaces() -> np.ndarray:
    """Grey, its metamer in daylight, a red, and a near copy of the red."""
    grey = np.full(31, 0.4)
    red = np.linspace(0.05, 0.8, 31)
    return np.stack([grey, red, metamer_of(grey, 0.3), red * 1.005])


def test_a_metamer_is_found_with_the_light_that_tells_it_apart_and_those_that_differ_most_first():
    assert metameric_pairs(surfaces()[[0, 1, 3]], LIGHTS, BANDS) == []  # alike everywhere or nowhere
    [pair] = metameric_pairs(surfaces(), LIGHTS, BANDS)
    assert (pair.first, pair.second, pair.alike_in, pair.different_in) == (0, 2, 0, 1)
    assert pair.differences[0] < 1e-3
    assert pair.differences[1] > 4
    grey = np.full(31, 0.4)
    three = np.stack([grey, *(metamer_of(grey, strength) for strength in (0.12, 0.3))])
    found = metameric_pairs(three, LIGHTS, BANDS, alike=0.5, different=1.0)
    greatest = [max(pair.differences) for pair in found]
    assert len(found) == 3
    assert greatest == sorted(greatest, reverse=True)
    middle = (greatest[0] + greatest[1]) / 2
    assert metameric_pairs(three, LIGHTS, BANDS, alike=0.5, different=middle) == found[:1]


@pytest.mark.parametrize(
    ("lights", "bands", "thresholds", "message"),
    [
        (LIGHTS[:1], BANDS, (2.0, 4.0), "at least two lights; found 1"),
        (LIGHTS, Bands.of(np.linspace(700, 1000, 31)), (2.0, 4.0), "can't tell colours apart"),
        ([*LIGHTS, BANDS.centers_nm > 660.0], BANDS, (2.0, 4.0), "light 3 of 3 has no power where the eye"),
        (LIGHTS, BANDS, (4.0, 4.0), "found 4 and 4"),
    ],
)
def test_what_makes_no_sense_is_refused(lights, bands, thresholds, message):
    with pytest.raises(SpectrumError, match=message):
        metameric_pairs(surfaces(), np.array(lights), bands, *thresholds)
