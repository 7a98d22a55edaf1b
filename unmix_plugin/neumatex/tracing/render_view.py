"""Whole pictures by the path tracer.

Notation: `H x W` pixels, `C` colours, `K` rays that meet the mesh.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.surface import Surface
from unmix_plugin.neumatex.tracing.path_tracer import reflected_radiance
from unmix_plugin.neumatex.tracing.primary_hits import PixelHits, pixel_hits, subpixel_offsets

_PATHS_AT_ONCE = 1 << 18
"""Paths of one call, which bounds the memory."""


def render_view(
    surface: Surface,
    ray_mesh: RayMesh,
    environment: Environment,
    cameras: Cameras,
    index: int = 0,
    *,
    samples: int = 64,
    bounces: int = 1,
    subpixels: int = 2,
    background: Literal["black", "environment"] = "black",
    generator: torch.Generator | None = None,
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
    """The picture of one camera, and the part of each pixel that the mesh covers.

    Args:
        cameras: In the mesh's space.
        index: Which of them.
        samples: Paths a pixel, spread over its rays; at least one a ray.
        subpixels: A pixel has subpixels x subpixels rays.
        background: What is seen where the mesh is not. With black, the colours are multiplied by alpha.
    Returns:
        Linear radiance and alpha; without gradient.
    """
    hits = pixel_hits(ray_mesh, cameras, index, subpixels)
    radiance = rays_radiance(
        surface, ray_mesh, environment, hits, samples=samples, bounces=bounces, generator=generator
    )
    image, alpha = hits.image(radiance), hits.alpha()
    if background == "environment":
        image = image + _background(ray_mesh, environment, cameras, index, subpixels)
    return image, alpha


@torch.no_grad()
def rays_radiance(
    surface: Surface,
    ray_mesh: RayMesh,
    environment: Environment,
    hits: PixelHits,
    *,
    samples: int,
    bounces: int = 1,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "K C"]:
    """Radiance along each ray of an image, chunk after chunk; samples are those of a pixel. Without gradient."""
    samples_a_ray = max(1, -(-samples // hits.rays_a_pixel))
    rows = torch.arange(len(hits), device=ray_mesh.device).split(max(1, _PATHS_AT_ONCE // samples_a_ray))
    parts = [
        reflected_radiance(
            surface,
            ray_mesh,
            environment,
            hits.points.select(part),
            hits.to_eye[part],
            samples=samples_a_ray,
            bounces=bounces,
            generator=generator,
        )
        for part in rows
    ]
    colours = environment.num_colours
    return torch.cat(parts) if parts else torch.zeros(0, colours, device=ray_mesh.device)


def _background(
    ray_mesh: RayMesh, environment: Environment, cameras: Cameras, index: int, subpixels: int
) -> Float[Tensor, "H W C"]:
    """Radiance of the environment where rays miss the mesh, as a mean over each pixel's rays."""
    width, height = cameras.size(index)
    total = torch.zeros(height * width, environment.num_colours, device=ray_mesh.device)
    for offset in subpixel_offsets(subpixels):
        rays = cameras.to(ray_mesh.device).image_rays(index, offset)
        missed = ~ray_mesh.blocked(rays.origins, rays.directions)
        total[missed] += environment.radiance(rays.directions[missed])
    return (total / subpixels**2).reshape(height, width, -1)
