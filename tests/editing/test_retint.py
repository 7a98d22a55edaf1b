"""The smoothest change to a colour: exact, smooth, within bounds, and nothing where nothing is asked."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.editing.apply import _LitReflectance, _retinted
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.material_library import measured_library

BANDS = Bands.of(np.linspace(400, 700, 31))
LIGHT = illuminant_power("D50", BANDS)
TO_RGB = LIGHT[:, None] * rgb_matrix(BANDS, torch.float64).numpy()


def surface(name: str = "red", bands: Bands = BANDS) -> _LitReflectance:
    return _LitReflectance(
        bands,
        measured_library().reflectance(f"checker/{name}", bands, "hold"),
        illuminant_power("D50", bands),
    )


def roughness(spectrum: np.ndarray) -> float:
    return float(np.square(np.diff(spectrum, n=2)).sum())


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(["red", "cyan", "white 9.5 (.05 D)", "blue flower"]), st.integers(0, 2**32 - 1))
def test_the_colour_of_any_smooth_surface_can_be_given_to_any_other(name, seed):
    g = np.random.default_rng(seed)
    other = np.interp(BANDS.centers_nm, np.linspace(400, 700, 6), g.uniform(0.05, 0.9, 6))
    changed = _retinted(surface(name), other @ TO_RGB)
    np.testing.assert_allclose(changed @ TO_RGB, other @ TO_RGB, atol=1e-5)
    assert changed.min() >= 0
    assert changed.max() <= 1


def test_asking_for_the_colour_that_it_has_changes_nothing():
    given_surface = surface("purple")
    changed = _retinted(given_surface, given_surface.reflectance @ TO_RGB)
    np.testing.assert_allclose(changed, given_surface.reflectance, atol=1e-9)


def test_no_random_change_to_the_same_colour_is_smoother():
    """Any admissible change differs from the smoothest by one that has no colour; adding such ones never helps."""
    given_surface = surface("foliage")
    target = surface("moderate red").reflectance * 0.8 @ TO_RGB
    changed = _retinted(given_surface, target)
    base = given_surface.reflectance + 0.05
    width = 10 / 300

    def cost(spectrum: np.ndarray) -> float:
        relative = (spectrum - given_surface.reflectance) / base
        return float(np.square(np.diff(relative)).sum() / width + np.square(relative).sum() * width)

    colourless = np.linalg.svd(TO_RGB.T)[2][3:]
    g = np.random.default_rng(0)
    for _ in range(200):
        step = 1e-3 * g.normal(size=len(colourless)) @ colourless
        if (changed + step).min() >= 0 and (changed + step).max() <= 1:
            assert cost(changed + step) >= cost(changed) * (1 - 1e-6)


def test_a_change_of_colour_keeps_the_fine_structure_and_leaves_the_infrared_alone():
    bands = Bands.of(np.linspace(400, 1000, 121))
    reflectance = np.clip(0.4 + 0.03 * np.sin(bands.centers_nm / 4), 0, 1)
    wide = _LitReflectance(bands, reflectance, np.ones(len(bands)))
    changed = _retinted(wide, np.array([0.45, 0.35, 0.3]))
    ratio = changed / reflectance
    assert roughness(ratio) < 0.1 * roughness(reflectance)
    assert abs(ratio[-1] - 1) < 0.35 * np.abs(ratio[bands.centers_nm < 700] - 1).max()


def test_black_can_be_given_a_colour():
    black = _LitReflectance(BANDS, np.zeros(len(BANDS)), LIGHT)
    target = np.array([0.3, 0.2, 0.1])
    np.testing.assert_allclose(_retinted(black, target) @ TO_RGB, target, atol=1e-5)


def encoded(linear_rgb: np.ndarray) -> np.ndarray:
    """As a display shows it."""
    return linear_to_srgb(torch.from_numpy(np.clip(linear_rgb, 0, 1))).numpy()


@pytest.mark.parametrize("colour", [[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.05, 0.1, 0.8]])
def test_of_a_colour_out_of_reach_the_nearest_is_taken(colour):
    """No random surface within the bounds comes nearer on a display, first order of the sRGB curve aside."""
    wanted = np.array(colour)
    changed = _retinted(surface(), wanted, greatest=0.75)
    assert changed.min() >= 0
    assert changed.max() <= 0.75
    missed = np.linalg.norm(encoded(changed @ TO_RGB) - encoded(wanted))
    assert missed > 0.01
    g = np.random.default_rng(0)
    for _ in range(300):
        other = np.interp(BANDS.centers_nm, np.linspace(400, 700, 7), g.choice([0, 0.75, 0.4], 7))
        assert np.linalg.norm(encoded(other @ TO_RGB) - encoded(wanted)) > 0.8 * missed


def test_a_higher_bound_reaches_brighter_colours():
    target = np.array([1.2, 1.1, 0.8])
    assert np.abs(_retinted(surface(), target) @ TO_RGB - target).max() > 0.05
    changed = _retinted(surface(), target, greatest=1.6)
    np.testing.assert_allclose(changed @ TO_RGB, target, atol=1e-5)
    assert 1 < changed.max() <= 1.6
