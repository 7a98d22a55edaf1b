"""Tone curves, the camera's response, and spectra as they are compared and shown."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.neumatex.fit import tone
from unmix_plugin.neumatex.fit.tone import CameraResponse, LampRatio, SpectralDisplay, tone_curve
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb


@pytest.mark.parametrize("name", ["srgb", "agx"])
def test_curves_increase_for_greys_and_stay_in_0_to_1(name):
    light = torch.logspace(-3, 1.2, 200)[:, None].expand(-1, 3)
    numbers = tone_curve(name)(light)
    assert (numbers.diff(dim=0) >= -1e-4).all()
    assert 0 <= numbers.min() <= numbers.max() <= 1
    assert numbers[-1].min() > 0.98


@pytest.mark.parametrize("name", ["linear", "srgb", "agx", "learnt"])
def test_slopes_are_those_of_differences(name):
    light = torch.tensor([[0.05, 0.18, 0.6], [0.3, 0.9, 0.02]], dtype=torch.float64)
    curve = CameraResponse().double() if name == "learnt" else tone_curve(name)
    assert torch.autograd.gradcheck(curve, light.requires_grad_())


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-5, 5), min_size=tone.NUM_COEFFICIENTS, max_size=tone.NUM_COEFFICIENTS))
def test_any_coefficients_give_a_curve_that_increases_from_0_to_1(coefficients):
    response = CameraResponse()
    response.coefficients.data = torch.tensor(coefficients)
    numbers = response(torch.linspace(0, 1, 500)[:, None])[:, 0].detach()
    assert numbers[0] == pytest.approx(0, abs=1e-3)
    assert numbers[-1] == pytest.approx(1, abs=1e-5)
    assert (numbers.diff() >= -1e-6).all()


def _filmic(light):
    """Of no family that the basis is made of: Hable's curve for games, 2010, normalised to 1."""

    def hable(x):
        return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3

    return hable(4 * light) / hable(torch.tensor(4.0))


@pytest.mark.parametrize("curve", [linear_to_srgb, _filmic])
def test_an_unknown_curve_and_exposure_are_found_from_light_and_numbers(curve):
    generator = torch.Generator().manual_seed(3)
    light = torch.rand(2000, 3, generator=generator) ** 2
    measured = curve(light)
    response = CameraResponse()
    optimizer = torch.optim.Adam(response.parameters(), lr=0.05)
    for _ in range(400):
        optimizer.zero_grad()
        (response(light / 1.7) - measured).square().mean().backward()
        optimizer.step()
    error = (response(light / 1.7) - measured).abs()
    assert error.mean() < 0.004
    assert error.max() < 0.03


LAMP = (0.2, 0.6, 1.0)


def test_the_curve_and_its_slope_have_no_step():
    assert_close(LampRatio(LAMP)(torch.tensor([0.1, 0.3, 0.5])), torch.full((3,), 0.5))
    curve = LampRatio((1.0,))
    ratio = torch.tensor([0.0, 0.5, 1 - 1e-3, 1 + 1e-3, 4.0]).requires_grad_()
    values = curve(ratio[:, None])[:, 0]
    (slope,) = torch.autograd.grad(values.sum(), ratio)
    assert_close(values, torch.tensor([0.0, 0.5, 0.999, 1.001, 2.3863]), atol=1e-4, rtol=0)
    assert_close(slope, torch.tensor([1.0, 1.0, 1.0, 0.999, 0.25]), atol=1e-4, rtol=0)


def test_relative_errors_of_bright_pixels_count_alike_and_dark_ones_have_no_boundless_weight():
    light = torch.tensor([0.0, 1e-4, 1.0, 40.0, 80.0])[:, None] * torch.tensor(LAMP)
    weights = LampRatio(LAMP).weights(light)[:, 0]
    assert_close(weights[3] / weights[4], torch.tensor(2.0), rtol=0.1, atol=0)
    assert_close(weights[0], weights[1], rtol=1e-3, atol=0)
    assert_close(weights.square().mean(), torch.tensor(1.0))


def test_the_weights_of_pixels_do_not_depend_on_the_exposure_nor_on_the_lamp():
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    weights = LampRatio((1.0, 1.0, 1.0)).weights(light)
    assert_close(LampRatio(LAMP).weights(7 * light * torch.tensor(LAMP)), weights)


def test_a_flat_spectrum_is_shown_as_a_grey():
    display = SpectralDisplay(Bands.of([450, 500, 550, 600, 650]))
    assert_close(display.rgb(torch.full((5,), 0.4)), torch.full((3,), 0.4))
    shown = display(torch.full((5,), 0.4))
    assert float(shown.max() - shown.min()) < 1e-3
