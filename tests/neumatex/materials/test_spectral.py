"""Spectral materials: what a constant mixture reflects in even light, band by band, and where gradients go."""

import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.neumatex.simple_materials import Uniform, unit
from unmix_plugin.neumatex.geometry.mesh import mesh_of
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.materials.albedos import ggx_albedo
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.neumatex.tracing.path_tracer import reflected_radiance

LIGHT = torch.tensor([0.2, 1.0, 0.6, 0.9, 0.4])
ENDMEMBERS = torch.tensor([[0.9, 0.5, 0.1, 0.3, 0.0], [0.0, 0.2, 1.0, 0.6, 0.1], [0.3, 0.3, 0.3, 0.3, 0.3]])


def _ball_in_even_light(family, values, samples=256):
    """Radiance (N B) of a ball of one material, and cosines to the eye."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    rays = RayMesh(mesh_of(torch.tensor(ball.vertices), torch.tensor(ball.faces)))
    targets = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    origins = torch.tensor((0.0, -4.0, 0.0)).expand(100, 3)
    directions = unit(targets - origins)
    points = rays.points(rays.closest(origins, directions), directions)
    radiance = reflected_radiance(
        Uniform(family, values),
        rays,
        Environment(LIGHT.expand(8, 16, 5).contiguous()),
        points,
        -directions,
        samples=samples,
        generator=torch.Generator().manual_seed(1),
    )
    return radiance, -(directions * points.normals).sum(dim=-1)


@pytest.mark.parametrize(("roughness", "level"), [(0.3, 0.2), (0.6, 0.7), (1.0, 0.0)])
def test_a_constant_mixture_in_even_light_is_its_closed_form_in_every_band(roughness, level):
    shares = torch.tensor([0.5, 0.2, 0.3])
    values = [*shares.tolist(), roughness, level]
    radiance, cosine = _ball_in_even_light(SpectralFamily(ENDMEMBERS), values)
    a, b = ggx_albedo(torch.full((1, len(cosine)), roughness), cosine)
    gloss = (level**2 * a + b)[0, :, None]
    expected = LIGHT * (gloss + (1 - gloss) * (shares @ ENDMEMBERS))
    assert_close(radiance, expected, rtol=0.02, atol=0.004)
    assert_close(radiance.mean(dim=0), expected.mean(dim=0), rtol=0.003, atol=0)


def test_a_white_furnace_sends_back_the_light_of_each_band():
    radiance, _ = _ball_in_even_light(SpectralFamily(torch.ones(1, 5)), [1.0, 0.5, 0.3])
    assert_close(radiance.mean(dim=0), LIGHT, rtol=0.003, atol=0)


def test_light_tells_endmembers_by_their_share():
    endmembers = ENDMEMBERS.clone().requires_grad_()
    radiance, cosine = _ball_in_even_light(SpectralFamily(endmembers), [0.5, 0.0, 0.5, 0.5, 0.2], samples=64)
    (gradient,) = torch.autograd.grad(radiance.mean(dim=0).sum(), endmembers)
    a, b = ggx_albedo(torch.full((1, len(cosine)), 0.5), cosine)
    passed = float((1 - (0.04 * a + b)).mean())
    assert_close(gradient[0], 0.5 * passed * LIGHT, rtol=0.01, atol=0)
    assert_close(gradient[0], gradient[2])
    assert gradient[1].abs().max() == 0
