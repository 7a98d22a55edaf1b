"""What the prior looks at: spread views, lobes of light, points of a mesh, and their features."""

import math

import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.neumatex.surfaces import ball, generator, mesh_from, unit
from unmix_plugin.neumatex.prior.observations import (
    NUM_LOBES,
    _light_lobes,
    _lobe_fits,
    known_light,
    sample_surface,
    well_spread,
)
from unmix_plugin.neumatex.tracing.environment import Environment, directions_of_pixels
from unmix_plugin.neumatex.tracing.rays import RayMesh


def test_of_a_ring_the_views_taken_are_evenly_spread():
    angles = torch.arange(12) * (2 * torch.pi / 12)
    positions = torch.stack([angles.cos(), angles.sin(), torch.zeros(12)], dim=-1) * 3
    assert well_spread(positions, 4) == [0, 3, 6, 9]
    coinciding = well_spread(torch.ones(5, 3), 4)
    assert coinciding == sorted(set(coinciding))
    assert well_spread(torch.eye(3), 12) == [0, 1, 2]


def test_the_irradiance_of_a_bright_half_follows_the_cosine():
    image = (directions_of_pixels(64, 128)[..., 2:] > 0).float().expand(64, 128, 3)
    diffuse, *_ = _light_lobes(Environment(image))
    tilts = torch.tensor([0.0, 60.0, 90.0, 180.0]).deg2rad()
    normals = torch.stack([tilts.sin(), torch.zeros(4), tilts.cos()], dim=-1)
    # The irradiance under a hemisphere of radiance 1 is pi (1 + cos tilt) / 2.
    assert_close(diffuse.radiance(normals)[:, 0], (1 + tilts.cos()) / 2, atol=0.01, rtol=0)
    even = _light_lobes(Environment(torch.full((64, 128, 3), 2.0), exposure_stops=1.0))
    directions = unit(torch.randn(50, 3, generator=generator()))
    assert len(even) == 1 + NUM_LOBES
    for lobe in even:
        assert_close(lobe.radiance(directions), torch.full((50, 3), 4.0))


@pytest.mark.parametrize("turn", [0.0, 70.0])
def test_a_spot_is_widened_more_by_blunter_lobes_and_turns_with_the_light(turn):
    angle, image = math.radians(turn), torch.zeros(64, 128, 3)
    spot = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    image[31:33, 63:65] = 100.0  # the picture's centre is +x before the turn
    _, *lobes = _light_lobes(Environment(image, turn))
    found = torch.stack([lobe.radiance(torch.stack([spot, -spot])) for lobe in lobes], dim=1)
    at_spot, opposite = found[0, :, 0], found[1, :, 0]
    assert (at_spot[:-1] > 2 * at_spot[1:]).all()
    assert (opposite[:-1] < 1e-6).all()


def sphere() -> RayMesh:
    return RayMesh(ball(4))


def even_light() -> Environment:
    return Environment(torch.full((32, 64, 3), 3.0))


def test_points_of_a_sphere_lie_on_it_evenly():
    points = sample_surface(sphere().mesh, 4000, generator())
    assert_close(points.positions.norm(dim=-1), torch.ones(4000), atol=3e-3, rtol=0)
    assert_close(points.normals, points.positions, atol=0.01, rtol=0)
    assert points.positions.mean(dim=0).abs().max() < 0.04
    # Bands of a sphere of the same height have the same area.
    assert_close(points.positions[:, 2].histc(5, -1, 1), torch.full((5,), 800.0), atol=100, rtol=0)


def test_a_camera_sees_the_half_of_a_sphere_that_faces_it():
    ray_mesh = sphere()
    points = sample_surface(ray_mesh.mesh, 500, generator())
    eyes = torch.tensor([[50.0, 0.0, 0.0], [0.0, 0.0, -50.0]])
    known = known_light(points, eyes, ray_mesh, even_light(), generator())
    along = torch.stack([points.positions[:, 0], -points.positions[:, 2]], dim=-1)
    assert known.visible[along > 0.15].all()
    assert not known.visible[along < 0.05].any()
    assert_close(known.cosines, along.clamp(0, 1), atol=0.03, rtol=0)


def test_nothing_shadows_a_sphere_and_light_is_in_units_of_its_mean():
    ray_mesh = sphere()
    points = sample_surface(ray_mesh.mesh, 200, generator())
    known = known_light(points, torch.tensor([[9.0, 0.0, 0.0]]), ray_mesh, even_light(), generator())
    assert_close(known.irradiance, torch.ones(200, 3), atol=1e-4, rtol=0)
    assert known.unshadowed.min() > 0.97
    seen = known.visible[:, 0]
    assert_close(known.mirrored[seen], torch.ones_like(known.mirrored[seen]), atol=1e-4, rtol=0)
    assert (known.mirror_open[seen] == 1).all()


def test_a_wall_hides_points_behind_it_and_halves_the_light_at_its_foot():
    floor = trimesh.creation.box((2.0, 2.0, 0.02))
    wall = trimesh.creation.box((0.02, 2.0, 40.0))
    wall.apply_translation((-0.2, 0.0, 20.0))
    ray_mesh = RayMesh(mesh_from(floor, wall))
    points = sample_surface(mesh_from(floor), 3000, generator())
    at_foot = (points.normals[:, 2] > 0.5) & (points.positions[:, 0].abs() < 0.19)
    at_foot &= (points.positions[:, 0] > -0.18) & (points.positions[:, 1].abs() < 0.3)
    points = points.select(at_foot)
    eyes = torch.tensor([[-9.0, 0.0, 5.0], [9.0, 0.0, 5.0]])
    known = known_light(points, eyes, ray_mesh, even_light(), generator())
    assert len(points.positions) > 20
    assert not known.visible[:, 0].any()
    assert known.visible[:, 1].all()
    # A wall in front of half the sky takes nearly half of the irradiance.
    assert abs(float(known.unshadowed.mean()) - 0.55) < 0.06
    # Seen from the right, the mirrored direction runs into the wall.
    assert (known.mirror_open[:, 1] == 0).all()


def made_of(lobe: int):
    """Colours of 30 points in 12 views: an albedo times the light that reaches them, and a share of one lobe."""
    g = generator()
    mirrored = 2 * torch.rand(30, 12, NUM_LOBES, 3, generator=g)
    reaching, albedo = 0.5 + torch.rand(30, 3, generator=g), torch.rand(30, 3, generator=g)
    share = 0.2 + 0.5 * torch.rand(30, 3, generator=g)
    colours = (albedo * (reaching + 0.02))[:, None] + share[:, None] * mirrored[:, :, lobe]
    return colours, mirrored, reaching, albedo, share


def test_a_fit_finds_albedo_and_share_and_leaves_nothing_only_for_the_right_lobe():
    colours, mirrored, reaching, albedo, share = made_of(lobe=2)
    fits = _lobe_fits(colours, mirrored, torch.ones(30, 12), reaching).unflatten(-1, (NUM_LOBES, 7))
    found_share, found_albedo, left = fits[:, 2].split((3, 3, 1), dim=-1)
    # The ridge of the fit makes shares a little small, most where the light happens to vary little.
    assert_close(found_share, share, atol=0.15, rtol=0)
    assert_close(found_albedo, albedo, atol=0.2, rtol=0)
    assert left.max() < 0.05
    assert fits[:, [0, 1, 3], 6].mean() > 0.5


def test_views_without_weight_change_nothing():
    colours, mirrored, reaching, _, _ = made_of(lobe=0)
    weights = torch.ones(30, 12)
    weights[:, 8:] = 0
    spoiled = colours.clone()
    spoiled[:, 8:] = 7.0
    expected = _lobe_fits(colours[:, :8], mirrored[:, :8], weights[:, :8], reaching)
    assert_close(_lobe_fits(spoiled, mirrored, weights, reaching), expected)
    assert torch.isfinite(_lobe_fits(colours, mirrored, torch.zeros(30, 12), reaching)).all()
