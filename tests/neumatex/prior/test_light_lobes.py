"""Lobes of a known light against their integrals."""

import math

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.lighting.environment import Environment, directions_of_pixels
from unmix_plugin.neumatex.prior.light_lobes import NUM_LOBES, light_lobes

UP = torch.tensor([[0.0, 0.0, 1.0]])


def test_an_even_light_is_the_same_in_every_lobe():
    lobes = light_lobes(Environment(torch.full((64, 128, 3), 2.0), exposure_stops=1.0))
    directions = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    assert_close(lobes.diffuse.radiance(directions), torch.full((50, 3), 4.0))
    assert_close(lobes.about(directions), torch.full((50, NUM_LOBES, 3), 4.0))


def test_the_irradiance_of_a_bright_half_follows_the_cosine():
    image = (directions_of_pixels(64, 128)[..., 2:] > 0).float().expand(64, 128, 3)
    lobes = light_lobes(Environment(image))
    tilts = torch.tensor([0.0, 60.0, 90.0, 180.0]).deg2rad()
    normals = torch.stack([tilts.sin(), torch.zeros(4), tilts.cos()], dim=-1)
    # The irradiance under a hemisphere of radiance 1 is pi (1 + cos tilt) / 2.
    assert_close(lobes.diffuse.radiance(normals)[:, 0], (1 + tilts.cos()) / 2, atol=0.01, rtol=0)


@pytest.mark.parametrize("turn", [0.0, 70.0])
def test_a_spot_is_widened_more_by_blunter_lobes_and_turns_with_the_light(turn):
    environment = Environment(torch.zeros(64, 128, 3), rotation_deg=turn)
    angle = math.radians(turn)
    spot = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    away = Environment(environment.image, turn).image.clone()
    away[31:33, 63:65] = 100.0  # the picture's centre is +x before the turn
    found = light_lobes(Environment(away, turn)).about(torch.stack([spot, -spot]))
    at_spot, opposite = found[0, :, 0], found[1, :, 0]
    assert (at_spot[:-1] > 2 * at_spot[1:]).all()
    assert (opposite[:-1] < 1e-6).all()
