"""Points on a mesh, who sees them and what light reaches them: cases whose answers are known."""

import torch
import trimesh
from torch.testing import assert_close

from unmix_plugin.neumatex.geometry.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.prior.surface_samples import known_light, sample_surface


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def mesh_from(shape: trimesh.Trimesh) -> Mesh:
    return mesh_of(torch.tensor(shape.vertices).float(), torch.tensor(shape.faces).int())


def sphere() -> RayMesh:
    return RayMesh(mesh_from(trimesh.creation.icosphere(subdivisions=4)))


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
    both = trimesh.util.concatenate([floor, wall])
    assert isinstance(both, trimesh.Trimesh)
    ray_mesh = RayMesh(mesh_from(both))
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
