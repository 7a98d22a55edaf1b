"""Where the rays of a camera's pixels meet a mesh.

A pixel has n x n rays through the middles of its n x n parts; n = 1 is the ray through the pixel's centre.

Notation: `H x W` pixels, `K` rays that meet the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh, SurfacePoints


@dataclass(frozen=True)
class PixelHits:
    """Surface points behind the pixels of one image."""

    pixels: Int[Tensor, " K"]
    """Pixel of each ray, row * W + column, increasing; a pixel has up to n x n rays."""
    points: SurfacePoints
    to_eye: Float[Tensor, "K 3"]
    """Unit vectors to the camera."""
    width: int
    height: int
    rays_a_pixel: int
    """n x n."""

    def __len__(self) -> int:
        return len(self.pixels)

    def alpha(self) -> Float[Tensor, "H W"]:
        """Part of each pixel's rays that meet the mesh."""
        counts = torch.bincount(self.pixels, minlength=self.width * self.height)
        return (counts.float() / self.rays_a_pixel).reshape(self.height, self.width)

    def image(self, values: Float[Tensor, "K C"]) -> Float[Tensor, "H W C"]:
        """Means over each pixel of values of its rays, 0 where a ray misses (so multiplied by alpha)."""
        sums = values.new_zeros(self.width * self.height, values.shape[1]).index_add(0, self.pixels, values)
        return (sums / self.rays_a_pixel).reshape(self.height, self.width, -1)

    def select(self, rows: Tensor) -> PixelHits:
        """Some of the rays, by increasing indices or a mask."""
        return PixelHits(
            self.pixels[rows],
            self.points.select(rows),
            self.to_eye[rows],
            self.width,
            self.height,
            self.rays_a_pixel,
        )


def pixel_hits(ray_mesh: RayMesh, cameras: Cameras, index: int, subpixels: int = 1) -> PixelHits:
    """The hits of one camera."""
    width, height = cameras.size(index)
    pixels, parts, to_eye = [], [], []
    for offset in subpixel_offsets(subpixels):
        rays = cameras.to(ray_mesh.device).image_rays(index, offset)
        hits = ray_mesh.closest(rays.origins, rays.directions)
        found = hits.found.nonzero()[:, 0]
        directions = rays.directions[found]
        parts.append(ray_mesh.points(hits.select(found), directions))
        pixels.append(found)
        to_eye.append(-directions)
    order = torch.cat(pixels).argsort(stable=True)
    points = SurfacePoints(
        torch.cat([part.positions for part in parts])[order],
        torch.cat([part.normals for part in parts])[order],
        torch.cat([part.geometric_normals for part in parts])[order],
    )
    return PixelHits(torch.cat(pixels)[order], points, torch.cat(to_eye)[order], width, height, subpixels**2)


def subpixel_offsets(subpixels: int) -> list[tuple[float, float]]:
    """Middles of the parts of a pixel, x and y in [0, 1]."""
    middles = [(index + 0.5) / subpixels for index in range(subpixels)]
    return [(x, y) for y in middles for x in middles]
