"""Environments: directions, densities and draws agree with each other."""

import math

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.lighting.built_in import NAMES, built_in_environment
from unmix_plugin.neumatex.lighting.environment import Environment, directions_of_pixels
from unmix_plugin.neumatex.lighting.picture_inversion import PictureInversion


def _uniforms(count, seed=0):
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _directions(count, seed=0):
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(normals, dim=-1)


def _spotty(height=16):
    g = torch.Generator().manual_seed(5)
    return Environment(torch.rand(height, 2 * height, 3, generator=g) ** 6)


@pytest.mark.parametrize(
    "weights", [[[1.0]], [[0, 3.0], [0, 0]], [[1, 1, 1, 1.0]] * 2, [[0.1, 7, 0], [0.2, 2, 2]]]
)
def test_pixels_are_drawn_by_their_weights_and_evenly_within(weights):
    given = torch.tensor(weights)
    axis = (torch.arange(600, dtype=torch.float64) + 0.5) / 600
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(-1, 2)
    row, column, down, across = PictureInversion.of(given).draw(grid)
    drawn = torch.zeros_like(given, dtype=torch.float64).index_put_(
        (row, column), torch.ones_like(down), True
    )
    assert_close(drawn / len(grid), given.double() / given.double().sum(), atol=3e-3, rtol=0)
    assert bool((drawn[given == 0] == 0).all())
    for place in (down, across):
        heaviest = place[(row * given.shape[1] + column) == given.argmax()]
        assert_close(heaviest.mean(), torch.tensor(0.5, dtype=torch.float64), atol=0.01, rtol=0)
        assert_close(heaviest.std(), torch.tensor(12**-0.5, dtype=torch.float64), atol=0.01, rtol=0)


def test_directions_follow_the_stated_convention():
    image = torch.zeros(4, 8, 3)
    image[2, 1] = torch.tensor([1.0, 2.0, 3.0])
    u, v = (1 + 0.5) / 8, (2 + 0.5) / 4
    azimuth, polar = 2 * math.pi * (0.5 - u), math.pi * v
    flat = math.sin(polar)
    direction = torch.tensor([[flat * math.cos(azimuth), flat * math.sin(azimuth), math.cos(polar)]])
    assert_close(Environment(image).radiance(direction), image[2, 1][None])
    assert_close(Environment(image, exposure_stops=1.0).radiance(direction), 2 * image[2, 1][None])
    turn = math.radians(30)
    turned = torch.tensor(
        [[flat * math.cos(azimuth + turn), flat * math.sin(azimuth + turn), math.cos(polar)]]
    )
    assert_close(Environment(image, rotation_deg=30.0).radiance(turned), image[2, 1][None])


def test_radiance_at_pixel_centres_is_the_picture():
    environment = _spotty()
    directions = directions_of_pixels(16, 32).reshape(-1, 3)
    assert_close(environment.radiance(directions), environment.image.reshape(-1, 3), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("rotation", [0.0, 77.0])
def test_density_integrates_to_one(rotation):
    environment = Environment(_spotty().image, rotation)
    mean = environment.density(_directions(400_000)).double().mean()
    assert_close(4 * math.pi * mean, torch.tensor(1.0, dtype=torch.float64), atol=0.02, rtol=0)


@pytest.mark.parametrize("rotation", [0.0, -120.0])
def test_draws_have_the_stated_density(rotation):
    environment = Environment(_spotty().image, rotation)
    directions, density = environment.sample(_uniforms(200_000))
    assert_close(directions.norm(dim=-1), torch.ones(200_000))
    same = torch.isclose(environment.density(directions), density, rtol=1e-4)
    assert same.float().mean() > 0.9999  # some fall on an edge of pixels
    smooth = directions[:, 0].exp() * (1 + directions[:, 2])
    estimate = (smooth / density).double().mean()
    uniform = _directions(400_000)
    expected = 4 * math.pi * (uniform[:, 0].exp() * (1 + uniform[:, 2])).double().mean()
    # The density of dark pixels is small, so single draws weigh much.
    assert_close(estimate, expected, rtol=0.03, atol=0)


def test_draws_of_a_bright_pixel_stay_near_it():
    image = torch.zeros(8, 16, 3)
    image[3, 5] = 1.0
    directions, density = Environment(image).sample(_uniforms(1000))
    centre = directions_of_pixels(8, 16)[3, 5]
    assert bool((directions @ centre > math.cos(math.radians(55))).all())
    assert bool((density > 0).all())


def test_a_black_environment_is_drawn_from_uniformly():
    directions, density = Environment(torch.zeros(4, 8, 3)).sample(_uniforms(4000))
    assert_close(density, torch.full((4000,), 1 / (4 * math.pi)))
    assert_close(directions.mean(dim=0), torch.zeros(3), atol=0.04, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_built_in_environments_are_seeded_and_well_exposed(name):
    first, again, other = (built_in_environment(name, seed, height=32) for seed in (1, 1, 2))
    assert torch.equal(first.image, again.image)
    assert not torch.equal(first.image, other.image)
    assert bool((first.image >= 0).all())
    assert_close(first.mean_radiance().mean(), torch.tensor(0.8), atol=1e-4, rtol=0)


def test_an_unknown_environment_is_refused():
    with pytest.raises(ConfigError, match="did you mean studio"):
        built_in_environment("studios")
