"""Blended Gaussians against their twin, finite differences and closed forms."""

import math

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.operators.splatting import splat, splat_twin, tile_lists

WIDTH, HEIGHT = 37, 21


def make(count, dtype=torch.float64, seed=0):
    """Gaussians of all shapes in and around the picture, some behind the camera and some too faint to be seen."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 2, generator=g, dtype=dtype) * torch.tensor([WIDTH + 10, HEIGHT + 10]) - 5
    roots = (
        torch.randn(count, 2, 2, generator=g, dtype=dtype)
        * torch.rand(count, 1, 1, generator=g, dtype=dtype)
        * 3
    )
    conics = (roots @ roots.mT + 0.3 * torch.eye(2, dtype=dtype)).inverse()
    conics = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], dim=-1)
    opacities = torch.rand(count, generator=g, dtype=dtype)
    colours = torch.randn(count, 4, generator=g, dtype=dtype)
    depths = torch.rand(count, generator=g, dtype=dtype) * 3 - 0.2
    return means, conics, opacities, colours, depths


@pytest.mark.parametrize("count", [0, 1, 30, 600])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pictures_and_their_gradients_agree_with_the_twin(count, dtype, device):
    *inputs, depths = (values.to(device) for values in make(count, dtype))
    inputs = [values.requires_grad_() for values in inputs]
    means, conics, opacities, colours = inputs
    lists = tile_lists(means, conics, opacities, depths, WIDTH, HEIGHT)
    actual = splat(means, conics, opacities, colours, lists)
    expected = splat_twin(means, conics, opacities, colours, depths, WIDTH, HEIGHT)
    rtol, atol = {torch.float32: (1e-3, 1e-4), torch.float64: (1e-8, 1e-10)}[dtype]
    assert_close(actual, expected, rtol=rtol, atol=atol)
    drawn = torch.Generator().manual_seed(1)
    cotangent = torch.randn(expected.shape, generator=drawn, dtype=dtype).to(device)
    found, wanted = (torch.autograd.grad(one, inputs, cotangent) for one in (actual, expected))
    assert_close(found, wanted, rtol=rtol, atol=10 * atol)


def test_gradients_are_those_of_finite_differences():
    means, conics, opacities, colours, depths = make(6, seed=3)
    opacities = 0.9 * opacities  # below the cut at 0.99
    lists = tile_lists(means, conics, opacities, depths, WIDTH, HEIGHT)
    inputs = [values.requires_grad_() for values in (means, conics, opacities, colours)]

    def picture(means, conics, opacities, colours):
        return splat(means, conics, opacities, colours, lists)

    assert torch.autograd.gradcheck(picture, inputs, eps=1e-7, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(("depths", "red"), [([1.0, 2.0], 0.25 * 0.5), ([2.0, 1.0], 0.5)])
def test_what_is_in_front_hides_what_is_behind_by_its_opacity(depths, red):
    means, conics = torch.full((2, 2), 10.5), torch.tensor([[1e-6, 0.0, 1e-6]]).repeat(2, 1)
    opacities, colours = torch.tensor([0.75, 0.5]), torch.tensor([[0.0, 1.0], [1.0, 1.0]])
    lists = tile_lists(means, conics, opacities, torch.tensor(depths), 21, 21)
    picture = splat(means, conics, opacities, colours, lists)
    assert_close(picture[10, 10], torch.tensor([red, 1 - 0.25 * 0.5]))


def test_the_light_of_a_gaussian_is_its_opacity_times_its_area():
    means, sigma = torch.tensor([[30.0, 30.0]], dtype=torch.float64), 4.0
    conics = torch.tensor([[sigma**-2, 0.0, sigma**-2]], dtype=torch.float64)
    opacity = torch.tensor([0.6], dtype=torch.float64)
    lists = tile_lists(means, conics, opacity, torch.ones(1, dtype=torch.float64), 60, 60)
    total = splat(means, conics, opacity, torch.ones(1, 1, dtype=torch.float64), lists).sum()
    ended = 2 * math.pi * sigma**2 / 255  # the rim below 1/255, in closed form
    assert total.item() == pytest.approx(0.6 * 2 * math.pi * sigma**2 - ended, rel=1e-3)
