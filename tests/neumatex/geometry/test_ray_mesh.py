"""Rays against meshes: kernels beside the brute-force twin, and points that rays can start from."""

import pytest
import torch
import trimesh
from torch.testing import assert_close

from unmix_plugin.neumatex.geometry.mesh import mesh_of
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh, closest_twin

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def _torus():
    torus = trimesh.creation.torus(0.7, 0.3, major_sections=24, minor_sections=12)
    return mesh_of(torch.tensor(torus.vertices), torch.tensor(torus.faces))


def _sphere(subdivisions=3):
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return mesh_of(torch.tensor(sphere.vertices), torch.tensor(sphere.faces))


def _rays(count, seed=0):
    g = torch.Generator().manual_seed(seed)
    origins = 1.5 * torch.randn(count, 3, generator=g)
    return origins, _unit(torch.randn(count, 3, generator=g) - origins)


def _unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=-1)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 1, 2000])
def test_closest_hits_are_those_of_the_twin(device, count):
    mesh, (origins, directions) = _torus(), _rays(count)
    expected = closest_twin(mesh, origins, directions)
    hits = RayMesh(mesh, device).closest(origins.to(device), directions.to(device))
    assert torch.equal(hits.found.cpu(), expected.found)
    assert torch.equal(hits.triangles.cpu(), expected.triangles)
    assert_close(hits.distances.cpu(), expected.distances, atol=2e-6, rtol=1e-6)
    assert_close(hits.barycentric.cpu(), expected.barycentric, atol=2e-5, rtol=0)
    assert count < 2000 or 0.2 < hits.found.float().mean() < 0.8


@pytest.mark.parametrize("device", DEVICES)
def test_a_ray_is_blocked_where_it_has_a_hit(device):
    rays, (origins, directions) = RayMesh(_torus(), device), _rays(2000, seed=1)
    origins, directions = origins.to(device), directions.to(device)
    assert torch.equal(rays.blocked(origins, directions), rays.closest(origins, directions).found)


def test_points_lie_on_the_surface_and_face_the_viewer():
    mesh, rays = _sphere(), None
    rays = RayMesh(mesh)
    origins, directions = _rays(500, seed=2)
    hits = rays.closest(origins, directions)
    origins, directions = origins[hits.found], directions[hits.found]
    hits = rays.closest(origins, directions)
    points = rays.points(hits, directions)
    assert_close(points.positions, origins + hits.distances[:, None] * directions, atol=2e-5, rtol=0)
    assert bool(((points.normals * directions).sum(-1) < 0).all())
    assert bool(((points.geometric_normals * directions).sum(-1) <= 0).all())
    outside = origins.norm(dim=-1) > 1
    assert_close(points.normals[outside], _unit(points.positions[outside]), atol=0.05, rtol=0)
    inside = origins.norm(dim=-1) < 0.9
    assert bool(inside.any())
    assert_close(points.normals[inside], -_unit(points.positions[inside]), atol=0.02, rtol=0)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_rays_leave_a_convex_surface_without_meeting_it(scale):
    mesh = _sphere().transformed(scale, torch.zeros(3))
    rays, (origins, directions) = RayMesh(mesh), _rays(4000, seed=3)
    origins = scale * 2 * _unit(origins)
    hits = rays.closest(origins, directions)
    origins, directions = origins[hits.found], directions[hits.found]
    points = rays.points(rays.closest(origins, directions), directions)
    # Nearly along the surface, where rounding would hurt first.
    tangent = _unit(torch.linalg.cross(points.geometric_normals, directions))
    assert not bool(rays.blocked(points.positions, _unit(tangent + 0.01 * points.geometric_normals)).any())
    assert bool(rays.blocked(points.positions, -points.geometric_normals).all())
