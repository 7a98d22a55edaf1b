"""Laws that hold for the reflectances of every family: reciprocity, exact densities, unbiased sampling, finiteness."""

import math

import pytest
import torch
from torch.testing import assert_close

from tests.neumatex.materials.hemisphere import eye_directions, numbers, spherical_grid, wide_parameters
from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.layered import LayeredFamily
from unmix_plugin.neumatex.materials.neural import NeuralFamily
from unmix_plugin.neumatex.materials.pbr import PbrFamily
from unmix_plugin.neumatex.materials.spectral import SpectralFamily

SPECTRAL = SpectralFamily(torch.tensor([[0.9, 0.5, 0.1, 0.3, 0.0], [0.0, 0.2, 1.0, 0.6, 0.1]]) / 2)
FAMILIES = [PbrFamily(), LayeredFamily(), NeuralFamily(), SPECTRAL]
each_family = pytest.mark.parametrize("family", FAMILIES, ids=lambda family: type(family).__name__)


@each_family
def test_light_and_eye_can_change_places(family: MaterialFamily):
    parameters = wide_parameters(500, family.num_parameters)
    wi, wo = eye_directions(500, seed=3), eye_directions(500, seed=4)
    assert_close(
        family.evaluate(parameters, wi, wo), family.evaluate(parameters, wo, wi), rtol=1e-3, atol=1e-6
    )


@each_family
def test_nothing_is_reflected_below_the_surface(family: MaterialFamily):
    parameters = wide_parameters(50, family.num_parameters)
    above, below = eye_directions(50, seed=3), eye_directions(50, seed=4) * torch.tensor([1.0, 1.0, -1.0])
    assert family.evaluate(parameters, below, above).abs().max() == 0
    assert family.evaluate(parameters, above, below).abs().max() == 0
    values = family.evaluate(parameters, above, above)
    assert values.min() >= 0
    assert (values.amax(-1) > 0).float().mean() > 0.9


@each_family
def test_the_density_integrates_to_one(family: MaterialFamily):
    # Lobes that the grid resolves: roughness of every kind at least 0.4.
    parameters = 0.4 + 0.6 * wide_parameters(5, family.num_parameters)
    wi, solid_angles = spherical_grid(500, 500)
    for row, wo in zip(parameters, eye_directions(5, lowest=0.2), strict=True):
        density = family.density(row.expand(len(wi), -1), wi, wo.expand_as(wi))
        assert float((density * solid_angles).sum()) == pytest.approx(1.0, abs=0.003)


@each_family
def test_samples_are_drawn_from_the_density(family: MaterialFamily):
    # The mean of 1 / density over samples that fall into a region is the region's solid angle.
    for row, wo in zip(wide_parameters(5, family.num_parameters), eye_directions(5, lowest=0.2), strict=True):
        rows, eyes = row.expand(100_000, -1), wo.expand(100_000, 3)
        wi = family.sample(rows, eyes, numbers(100_000, 3))
        assert_close(wi.norm(dim=-1), torch.ones(len(wi)), atol=1e-4, rtol=0)
        inverse = 1.0 / family.density(rows, wi, eyes)
        regions = {2 * math.pi * 0.7: wi[:, 2] > 0.3, math.pi * 0.9: (wi[:, 2] > 0.1) & (wi[:, 0] > 0)}
        for solid_angle, region in regions.items():
            assert float((inverse * region).mean()) == pytest.approx(solid_angle, rel=0.04)


@each_family
def test_sampling_estimates_the_same_reflected_light_as_a_uniform_sphere(family: MaterialFamily):
    parameters = 0.3 + 0.7 * wide_parameters(4, family.num_parameters)
    grid, solid_angles = spherical_grid(400, 400)
    for row, wo in zip(parameters, eye_directions(4), strict=True):
        light = 1.0 + grid[:, :1] + grid[:, 2:]
        values = family.evaluate(row.expand(len(grid), -1), grid, wo.expand_as(grid)) * light
        expected = (values * (grid[:, 2].clamp_min(0) * solid_angles)[:, None]).sum(0)
        rows, eyes = row.expand(60_000, -1), wo.expand(60_000, 3)
        wi = family.sample(rows, eyes, numbers(60_000, 3))
        values = family.evaluate(rows, wi, eyes) * (1.0 + wi[:, :1] + wi[:, 2:])
        found = values * (wi[:, 2].clamp_min(0) / family.density(rows, wi, eyes))[:, None]
        assert_close(found.mean(0), expected, rtol=0.015, atol=1e-3)


@each_family
def test_importance_sampling_keeps_weights_small(family: MaterialFamily):
    parameters = wide_parameters(100_000, family.num_parameters)
    wo = eye_directions(100_000, lowest=0.01)
    wi = family.sample(parameters, wo, numbers(100_000, 3))
    cosine = wi[:, 2].clamp_min(0.0)
    weights = family.evaluate(parameters, wi, wo) * (cosine / family.density(parameters, wi, wo))[:, None]
    assert weights.isfinite().all()
    assert float(weights.max()) < 40


@each_family
@pytest.mark.parametrize("lowest", [0.0, 1e-6, 1e-3])
def test_values_and_gradients_are_finite_up_to_the_horizon(family: MaterialFamily, lowest: float):
    parameters = wide_parameters(2000, family.num_parameters).requires_grad_()
    z = torch.full((2000,), lowest)
    wi = torch.stack([torch.sqrt(1 - z * z), torch.zeros(2000), z], -1)
    for wo in (wi, wi * torch.tensor([-1.0, 1.0, 1.0]), eye_directions(2000)):
        values = family.evaluate(parameters, wi, wo)
        (gradient,) = torch.autograd.grad(values.sum(), parameters)
        assert values.isfinite().all()
        assert gradient.isfinite().all()
        assert family.density(parameters, wi, wo).isfinite().all()


@each_family
def test_gradients_are_those_of_finite_differences(family: MaterialFamily):
    parameters = (0.25 + 0.5 * numbers(20, family.num_parameters)).requires_grad_()
    wi, wo = eye_directions(20, seed=5), eye_directions(20, seed=6)
    (gradient,) = torch.autograd.grad(family.evaluate(parameters, wi, wo).sum(), parameters)
    step = 2e-3
    with torch.no_grad():
        for column in range(family.num_parameters):
            shift = step * torch.eye(family.num_parameters)[column]
            rise = family.evaluate(parameters + shift, wi, wo) - family.evaluate(parameters - shift, wi, wo)
            assert_close(gradient[:, column], rise.sum(-1) / (2 * step), rtol=0.05, atol=0.02)


@pytest.mark.parametrize("family", FAMILIES[:2], ids=lambda family: type(family).__name__)
def test_the_base_colour_is_the_first_three_parameters(family: MaterialFamily):
    parameters = wide_parameters(5, family.num_parameters)
    assert torch.equal(family.base_colour(parameters), parameters[:, :3])


def test_the_base_colour_of_a_neural_metal_is_what_it_reflects():
    # Copper, half and wholly metal, and a red dielectric; the diffuse colour of the metal is of no consequence.
    layered = torch.zeros(3, LayeredFamily.num_parameters)
    layered[:, :6] = torch.tensor(
        [[0.95, 0.64, 0.37, 1.0, 0.3, 0.5], [0.95, 0.64, 0.37, 0.7, 0.3, 0.5], [0.8, 0.1, 0.1, 0.0, 0.3, 0.5]]
    )
    family = NeuralFamily()
    parameters = family.from_layered(layered)
    parameters[0, :3] = 0.2
    assert_close(family.base_colour(parameters), layered[:, :3], atol=0.06, rtol=0)
    decoded = family.decoded_family.base_colour(family.decoded(parameters))
    assert_close(decoded, family.base_colour(parameters))
