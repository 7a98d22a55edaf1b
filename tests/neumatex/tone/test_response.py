"""The learnt response increases whatever its coefficients, and finds curves that it was not told of."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.neumatex.tone.response import NUM_COEFFICIENTS, CameraResponse
from unmix_plugin.spectral.colour.conversion import linear_to_srgb


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-5, 5), min_size=NUM_COEFFICIENTS, max_size=NUM_COEFFICIENTS))
def test_any_coefficients_give_a_curve_that_increases_from_0_to_1(coefficients):
    response = CameraResponse()
    response.coefficients.data = torch.tensor(coefficients)
    light = torch.linspace(0, 1, 500)[:, None]
    numbers = response(light)[:, 0].detach()
    assert numbers[0] == pytest.approx(0, abs=1e-3)
    assert numbers[-1] == pytest.approx(1, abs=1e-5)
    assert (numbers.diff() >= -1e-6).all()


def _filmic(light):
    """Of no family that the basis is made of: Hable's curve for games, 2010, normalised to 1."""

    def hable(x):
        return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3

    return hable(4 * light) / hable(torch.tensor(4.0))


@pytest.mark.parametrize(("name", "curve"), [("sRGB", linear_to_srgb), ("filmic", _filmic)])
def test_an_unknown_curve_and_exposure_are_found_from_light_and_numbers(name, curve):
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
    assert error.mean() < 0.004, name
    assert error.max() < 0.03, name


def test_its_slope_by_light_is_that_of_differences():
    response = CameraResponse().double()
    light = torch.tensor([[0.013, 0.2, 0.71]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(response(light).sum(), light)
    step = 1e-7
    expected = (response(light + step) - response(light - step)) / (2 * step)
    torch.testing.assert_close(slope, expected, rtol=1e-4, atol=1e-6)
