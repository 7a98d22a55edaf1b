"""Points on a mesh, and what is known of them before any picture is read: who sees them, and what light reaches them.

Notation: `N` points in model space, `V` views, `K` lobes of light. All light is divided by the environment's mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh, SurfacePoints
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.prior.light_lobes import light_lobes

_LEAST_COSINE = 0.08
"""Views that graze a point more than this say little of it."""
_OFF_SURFACE = 2e-5
"""Distance from the surface at which rays start, model units."""
_SHADOW_RAYS = 32


@dataclass(frozen=True)
class KnownLight:
    """Views and light at points of a surface."""

    visible: Bool[Tensor, "N V"]
    """Whether a view's camera sees a point."""
    cosines: Float[Tensor, "N V"]
    """Between the normal and the direction to the camera."""
    mirrored: Float[Tensor, "N V K 3"]
    """Light in lobes about the mirrored direction of each view, as if nothing were in the way."""
    mirror_open: Float[Tensor, "N V"]
    """1 where the mirrored direction leaves the object, 0 where it meets it again."""
    irradiance: Float[Tensor, "N 3"]
    """Over pi, as if nothing were in the way."""
    unshadowed: Float[Tensor, "N 3"]
    """Share of the irradiance that the object itself does not block."""


def sample_surface(mesh: Mesh, count: int, generator: torch.Generator) -> SurfacePoints:
    """Points of a mesh, uniform by area, a little above the surface."""
    corners = mesh.corners()
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    crossed = torch.linalg.cross(*edges)
    faces = torch.multinomial(crossed.norm(dim=-1), count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, 1, generator=generator).unbind()
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    weights = torch.stack([1 - u - v, u, v], dim=1)
    geometric = functional.normalize(crossed[faces], dim=-1)
    positions = (weights * corners[faces]).sum(dim=1)
    normals = (weights * mesh.normals[mesh.faces[faces].long()]).sum(dim=1)
    normals = functional.normalize(normals, dim=-1)
    # A file's normals may disagree with the winding of its triangles; the normals say which side is outside.
    geometric = torch.where((geometric * normals).sum(dim=-1, keepdim=True) < 0, -geometric, geometric)
    return SurfacePoints(positions + _OFF_SURFACE * geometric, normals, geometric)


def known_light(
    points: SurfacePoints,
    eyes: Float[Tensor, "V 3"],
    ray_mesh: RayMesh,
    environment: Environment,
    generator: torch.Generator,
) -> KnownLight:
    """What is known of points before pictures are read.

    Args:
        eyes: Positions of the cameras, model space, outside the mesh.
        generator: Draws the directions of shadow rays.
    """
    lobes = light_lobes(environment)
    mean = environment.mean_radiance().mean().clamp(min=1e-12)
    to_eye = functional.normalize(eyes - points.positions[:, None], dim=-1)
    cosines = (to_eye * points.normals[:, None]).sum(dim=-1)
    above = (to_eye * points.geometric_normals[:, None]).sum(dim=-1)
    facing = (cosines > _LEAST_COSINE) & (above > _LEAST_COSINE)
    mirrored = functional.normalize(2 * cosines[..., None] * points.normals[:, None] - to_eye, dim=-1)
    shape = facing.shape
    return KnownLight(
        visible=facing & _open(points, to_eye, facing, ray_mesh),
        cosines=cosines.clamp(0, 1),
        mirrored=lobes.about(mirrored.reshape(-1, 3)).unflatten(0, shape) / mean,
        mirror_open=_open(points, mirrored, facing, ray_mesh).float(),
        irradiance=lobes.diffuse.radiance(points.normals) / mean,
        unshadowed=_unshadowed(points, ray_mesh, environment, generator),
    )


def _open(points: SurfacePoints, directions: Tensor, wanted: Tensor, ray_mesh: RayMesh) -> Tensor:
    """Whether rays leave the object; False where they are not wanted."""
    found = torch.zeros_like(wanted)
    rows = wanted.nonzero()[:, 0]
    found[wanted] = ~ray_mesh.blocked(points.positions[rows], directions[wanted])
    return found


def _unshadowed(
    points: SurfacePoints, ray_mesh: RayMesh, environment: Environment, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """Ratio of two estimates from the same directions: with and without the object in the way."""
    repeated = points.select(torch.arange(len(points.positions)).repeat_interleave(_SHADOW_RAYS))
    directions, density = environment.sample(torch.rand(len(repeated.positions), 2, generator=generator))
    cosines = (directions * repeated.normals).sum(dim=-1).clamp(min=0)
    light = environment.radiance(directions) * (cosines / density.clamp(min=1e-12))[:, None]
    is_open = _open(repeated, directions[:, None], (cosines > 0)[:, None], ray_mesh)
    total, reaching = (
        values.unflatten(0, (-1, _SHADOW_RAYS)).sum(dim=1) for values in (light, light * is_open)
    )
    return torch.where(total > 0, reaching / total.clamp(min=1e-12), 1.0)
