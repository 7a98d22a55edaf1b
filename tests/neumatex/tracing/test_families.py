"""Families of materials: shading frames, reciprocity, energy, sampling, and closed forms."""

import math

import pytest
import torch
from torch.testing import assert_close

from tests.factories.surfaces import (
    Uniform,
    ball,
    eye_directions,
    generator,
    numbers,
    spherical_grid,
    unit,
    wide_parameters,
)
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.neumatex.tracing.families import LayeredFamily, MaterialFamily, PbrFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.layers import ggx_albedo
from unmix_plugin.neumatex.tracing.microfacet import frames, to_local, to_world
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.path_tracer import TracedObject
from unmix_plugin.neumatex.tracing.rays import RayMesh


def test_frames_are_rotations_whose_z_axis_is_the_normal():
    axes = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    normals = unit(torch.cat([numbers(200, 3) - 0.5, axes]))
    directions, found = unit(numbers(203, 3, seed=9) - 0.5), frames(normals)
    assert_close(found @ found.mT, torch.eye(3).expand_as(found), atol=1e-5, rtol=0)
    assert_close(torch.linalg.det(found), torch.ones(len(found)), atol=1e-5, rtol=0)
    assert_close(to_world(found, axes[:1].expand_as(normals)), normals)
    assert_close(to_world(found, to_local(found, directions)), directions, atol=1e-5, rtol=0)


SPECTRAL = SpectralFamily(torch.tensor([[0.9, 0.5, 0.1, 0.3, 0.0], [0.0, 0.2, 1.0, 0.6, 0.1]]) / 2)
FAMILIES = [PbrFamily(), LayeredFamily(), NeuralFamily(), SPECTRAL]
each_family = pytest.mark.parametrize("family", FAMILIES, ids=lambda family: type(family).__name__)


@each_family
def test_light_and_eye_can_change_places(family: MaterialFamily):
    parameters = wide_parameters(500, family.num_parameters)
    wi, wo = eye_directions(500, seed=3), eye_directions(500, seed=4)
    values = family.evaluate(parameters, wi, wo)
    assert_close(values, family.evaluate(parameters, wo, wi), rtol=1e-3, atol=1e-6)
    assert family.evaluate(parameters[:0], wi[:0], wo[:0]).shape == values[:0].shape
    assert family.sample(parameters[:0], wo[:0], wi[:0]).shape == (0, 3)
    assert family.density(parameters[:0], wi[:0], wo[:0]).shape == (0,)


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
    wi, solid_angles = spherical_grid(500)
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
    decoded_family, decoded = family.decoded(parameters)
    assert_close(decoded_family.base_colour(decoded), family.base_colour(parameters))


FAMILY = LayeredFamily()
INDEX = {name: i for i, name in enumerate(LayeredFamily.PARAMETERS)}


def albedo(parameters: torch.Tensor, wo: torch.Tensor, family: MaterialFamily = FAMILY) -> torch.Tensor:
    """Share of light that one material reflects from one direction, by importance sampling."""
    uniforms = torch.quasirandom.SobolEngine(3, scramble=True, seed=0).draw(1 << 15)
    rows, eyes = parameters.expand(len(uniforms), -1), wo.expand(len(uniforms), 3)
    wi = family.sample(rows, eyes, uniforms)
    weights = wi[:, 2].clamp_min(0) / family.density(rows, wi, eyes)
    return (family.evaluate(rows, wi, eyes) * weights[:, None]).mean(0)


def material(**named: float) -> torch.Tensor:
    """All 0 but a grey base, roughness 0.5, specular level 0.5 and what is named."""
    parameters = torch.zeros(FAMILY.num_parameters)
    parameters[:3] = 0.5
    for name, value in ({"roughness": 0.5, "specular_level": 0.5} | named).items():
        parameters[INDEX[name.replace("_", " ")]] = value
    return parameters


@pytest.mark.parametrize("family", [FAMILY, NeuralFamily()])
def test_a_white_furnace_is_never_brightened(family: MaterialFamily):
    white = wide_parameters(24, family.num_parameters)
    white[:, :3] = 1.0
    found = torch.stack([albedo(row, wo, family) for row, wo in zip(white, eye_directions(24), strict=True)])
    assert float(found.max()) < 1.005


@pytest.mark.parametrize("roughness", [0.2, 0.6, 1.0])
def test_a_white_dielectric_gives_back_all_light(roughness: float):
    white = material(roughness=roughness)
    white[:3] = 1.0
    for wo in eye_directions(4, lowest=0.1):
        assert albedo(white, wo).tolist() == pytest.approx([1.0] * 3, abs=0.01)


@pytest.mark.parametrize(("roughness", "level"), [(0.0, 0.99977), (0.1, 1.0), (0.2, 0.99), (0.5, 0.9)])
def test_a_bright_gloss_over_a_white_base_gives_back_all_light(roughness: float, level: float):
    white = SpectralFamily(torch.ones(1, 1))
    for cosine in (0.01, 0.1, 0.5):
        wo = torch.tensor([math.sqrt(1 - cosine**2), 0.0, cosine])
        found = albedo(torch.tensor([1.0, roughness, level]), wo, white)
        assert found.tolist() == pytest.approx([1.0], abs=0.02)


UP = torch.tensor([[0.0, 0.0, 1.0]])


def test_without_gloss_only_the_base_is_left_and_metal_passes_nothing_and_reflects_in_its_colour():
    matt, metal = material(specular_level=0.0, roughness=1.0)[None], material(metallicity=1.0)
    assert FAMILY.evaluate(matt, UP, UP)[0].tolist() == pytest.approx([0.5 / math.pi] * 3, rel=0.03)
    metal[:3] = torch.tensor([0.9, 0.6, 0.2])
    passed, specular = FAMILY.stack(metal[None]).reflectance(UP.T, UP.T)
    assert float(passed) == 0.0
    assert (specular[:, 0] / specular[0, 0]).tolist() == pytest.approx([1.0, 2 / 3, 2 / 9], rel=1e-4)


@pytest.mark.parametrize("layer", ["dust", "sheen_weight", "coat_weight"])
def test_a_layer_dims_the_base_below_it(layer: str):
    wi, wo = eye_directions(50, seed=7).T, eye_directions(50, seed=8).T
    bare, _ = FAMILY.stack(material().expand(50, -1)).reflectance(wi, wo)
    covered, _ = FAMILY.stack(material(**{layer: 1.0}).expand(50, -1)).reflectance(wi, wo)
    assert (covered < 0.99 * bare).all()


def test_haze_moves_light_from_the_highlight_to_its_surroundings():
    aside = torch.tensor([[math.sin(0.3), 0.0, math.cos(0.3)]])
    materials = (material(roughness=0.2, haze_weight=weight)[None] for weight in (0.0, 1.0))
    sharp, hazy = ([FAMILY.evaluate(one, wi, UP)[0, 0] for wi in (UP, aside)] for one in materials)
    assert hazy[0] < 0.5 * sharp[0]
    assert hazy[1] > sharp[1]


def test_albedo_of_the_tables_is_that_of_the_lobes():
    """A black metal-free base under one layer: what the stack reflects is what its tables say."""
    grid, solid_angles = spherical_grid(800)
    parameters = material(specular_level=1.0, roughness=0.6)
    parameters[:3] = 0.0
    for wo in eye_directions(4, lowest=0.1):
        eyes = wo.expand_as(grid).T
        stack = FAMILY.stack(parameters.expand(len(grid), -1))
        _, specular = stack.reflectance(grid.T, eyes)
        reflected = float((specular[0] * grid[:, 2].clamp_min(0) * solid_angles).sum())
        surface = FAMILY.stack(parameters[None])._passing(wo[2:]).surface
        assert 1.0 - float(surface) == pytest.approx(reflected, abs=0.003)


LIGHT = torch.tensor([0.2, 1.0, 0.6, 0.9, 0.4])
ENDMEMBERS = torch.tensor([[0.9, 0.5, 0.1, 0.3, 0.0], [0.0, 0.2, 1.0, 0.6, 0.1], [0.3, 0.3, 0.3, 0.3, 0.3]])


@pytest.mark.parametrize(("roughness", "level"), [(0.3, 0.2), (0.6, 0.7), (1.0, 0.0)])
def test_a_constant_mixture_in_even_light_is_its_closed_form_in_every_band(roughness, level):
    rays, origins = RayMesh(ball(4)), torch.tensor((0.0, -4.0, 0.0)).expand(100, 3)
    _, points = rays.seen(origins, unit(numbers(100, 3) - 0.5 - origins))
    shares, light = torch.tensor([0.5, 0.2, 0.3]), Environment(LIGHT.expand(8, 16, 5).contiguous())
    surface = Uniform(SpectralFamily(ENDMEMBERS), [*shares.tolist(), roughness, level])
    radiance = TracedObject(rays, light, surface).light(points, 256, generator=generator(1))
    cosine = (points.to_eye * points.normals).sum(dim=-1)
    a, b = ggx_albedo(torch.full((1, len(cosine)), roughness), cosine)
    gloss = (level**2 * a + b)[0, :, None]
    expected = LIGHT * (gloss + (1 - gloss) * (shares @ ENDMEMBERS))
    assert_close(radiance, expected, rtol=0.02, atol=0.004)
    assert_close(radiance.mean(dim=0), expected.mean(dim=0), rtol=0.003, atol=0)
