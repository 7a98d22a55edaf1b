"""Layered materials keep the light they get, and each layer does what it is there for."""

import math

import pytest
import torch

from tests.neumatex.materials.hemisphere import eye_directions, spherical_grid, wide_parameters
from unmix_plugin.neumatex.materials.layered import LayeredFamily

FAMILY = LayeredFamily()
INDEX = {name: i for i, name in enumerate(LayeredFamily.PARAMETERS)}


def albedo(parameters: torch.Tensor, wo: torch.Tensor) -> torch.Tensor:
    """Share of light that one material reflects from one direction, by importance sampling."""
    uniforms = torch.quasirandom.SobolEngine(3, scramble=True, seed=0).draw(1 << 15)
    rows, eyes = parameters.expand(len(uniforms), -1), wo.expand(len(uniforms), 3)
    wi = FAMILY.sample(rows, eyes, uniforms)
    weights = wi[:, 2].clamp_min(0) / FAMILY.density(rows, wi, eyes)
    return (FAMILY.evaluate(rows, wi, eyes) * weights[:, None]).mean(0)


def material(**named: float) -> torch.Tensor:
    """All 0 but a grey base, roughness 0.5, specular level 0.5 and what is named."""
    parameters = torch.zeros(FAMILY.num_parameters)
    parameters[:3] = 0.5
    for name, value in ({"roughness": 0.5, "specular_level": 0.5} | named).items():
        parameters[INDEX[name.replace("_", " ")]] = value
    return parameters


def test_a_white_furnace_is_never_brightened():
    white = wide_parameters(60, FAMILY.num_parameters)
    white[:, :3] = 1.0
    found = torch.stack([albedo(row, wo) for row, wo in zip(white, eye_directions(60), strict=True)])
    assert float(found.max()) < 1.005


@pytest.mark.parametrize("roughness", [0.2, 0.6, 1.0])
def test_a_white_dielectric_gives_back_all_light(roughness: float):
    white = material(roughness=roughness)
    white[:3] = 1.0
    for wo in eye_directions(4, lowest=0.1):
        assert albedo(white, wo).tolist() == pytest.approx([1.0] * 3, abs=0.01)


def test_without_layers_or_gloss_only_the_base_is_left():
    parameters = material(specular_level=0.0, roughness=1.0)
    wi = wo = torch.tensor([[0.0, 0.0, 1.0]])
    assert FAMILY.evaluate(parameters[None], wi, wo)[0].tolist() == pytest.approx(
        [0.5 / math.pi] * 3, rel=0.03
    )


def test_metal_reflects_in_its_colour_and_passes_nothing():
    parameters = material(metallicity=1.0)
    parameters[:3] = torch.tensor([0.9, 0.6, 0.2])
    wo = torch.tensor([[0.0, 0.0, 1.0]])
    passed, specular = FAMILY.stack(parameters[None]).reflectance(wo.T, wo.T)
    assert float(passed) == 0.0
    assert (specular[:, 0] / specular[0, 0]).tolist() == pytest.approx([1.0, 2 / 3, 2 / 9], rel=1e-4)


@pytest.mark.parametrize("layer", ["dust", "sheen_weight", "coat_weight"])
def test_a_layer_dims_the_base_below_it(layer: str):
    wi, wo = eye_directions(50, seed=7).T, eye_directions(50, seed=8).T
    bare, _ = FAMILY.stack(material().expand(50, -1)).reflectance(wi, wo)
    covered, _ = FAMILY.stack(material(**{layer: 1.0}).expand(50, -1)).reflectance(wi, wo)
    assert (covered < 0.99 * bare).all()


def test_haze_moves_light_from_the_highlight_to_its_surroundings():
    wo = torch.tensor([[0.0, 0.0, 1.0]])
    aside = torch.tensor([[math.sin(0.3), 0.0, math.cos(0.3)]])
    sharp, hazy = (material(roughness=0.2, haze_weight=weight)[None] for weight in (0.0, 1.0))
    assert FAMILY.evaluate(hazy, wo, wo)[0, 0] < 0.5 * FAMILY.evaluate(sharp, wo, wo)[0, 0]
    assert FAMILY.evaluate(hazy, aside, wo)[0, 0] > FAMILY.evaluate(sharp, aside, wo)[0, 0]


def test_albedo_of_the_tables_is_that_of_the_lobes():
    """A black metal-free base under one layer: what the stack reflects is what its tables say."""
    grid, solid_angles = spherical_grid(800, 800)
    parameters = material(specular_level=1.0, roughness=0.6)
    parameters[:3] = 0.0
    for wo in eye_directions(4, lowest=0.1):
        eyes = wo.expand_as(grid).T
        stack = FAMILY.stack(parameters.expand(len(grid), -1))
        _, specular = stack.reflectance(grid.T, eyes)
        reflected = float((specular[0] * grid[:, 2].clamp_min(0) * solid_angles).sum())
        surface = FAMILY.stack(parameters[None]).passing(wo[2:]).surface
        assert 1.0 - float(surface) == pytest.approx(reflected, abs=0.003)
