"""Rays against a triangle mesh: closest hits, occlusion, surface points that new rays can start from, and pixels.

A pixel has n x n rays through the middles of its n x n parts; n = 1 is the ray through the pixel's centre.

Notation: `N` rays. A ray's direction has unit length, so that distances are in the mesh's unit. `H x W` pixels of a
picture, `K` of its rays meet the mesh.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine import Cameras
from unmix_plugin.neumatex.tracing.mesh import Mesh
from unmix_plugin.operators.launching import as_warp, launch, vector_type, warp

_LONGEST = 1e30
"""Distance of a ray that hits nothing."""

_OFFSET = 4e-6
"""Distance from a surface at which rays leave it, as part of the mesh's greatest coordinate: float32 positions are
wrong by a few 1e-7 of it."""

_LEAST_COSINE = 0.02
"""Shading normals are bent to the viewer where interpolation turned them further away than this."""


@dataclass(frozen=True)
class Hits:
    """Where rays first meet a mesh."""

    found: Bool[Tensor, " N"]
    triangles: Int[Tensor, " N"]
    """Triangle of each hit, int64; -1 where there is none."""
    barycentric: Float[Tensor, "N 2"]
    """Weights of the triangle's first and second vertex; the third has what is missing to 1."""
    distances: Float[Tensor, " N"]
    """Along the ray; 1e30 where nothing is hit."""

    def select(self, rows: Tensor) -> Hits:
        """Hits of some of the rays: by a mask or by indices."""
        return Hits(**{name: part[rows] for name, part in vars(self).items()})


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface as a viewer sees them."""

    positions: Float[Tensor, "N 3"]
    """Off the surface by a tiny distance on the viewer's side, so that new rays don't meet it where they start."""
    normals: Float[Tensor, "N 3"]
    """Unit shading normals, turned to the viewer."""
    geometric_normals: Float[Tensor, "N 3"]
    """Unit normals of the triangles, turned to the viewer."""
    to_eye: Float[Tensor, "N 3"]
    """Unit vectors to the viewer."""
    eyes: Float[Tensor, "N 3"] | None = None
    """Where rays of cameras that meet the points start; None of other rays."""

    def select(self, rows: Tensor) -> SurfacePoints:
        """Some of the points: by a mask or by indices."""
        parts = {name: part[rows] for name, part in vars(self).items() if part is not None}
        return SurfacePoints(**parts)


class RayMesh:
    """A mesh with a tree over its triangles, on one device."""

    def __init__(self, mesh: Mesh, device: torch.device | str = "cpu") -> None:
        self.mesh = mesh.to(device)
        self.device = self.mesh.vertices.device
        wp = warp()
        self._vertices = self.mesh.vertices.contiguous()
        self._faces = self.mesh.faces.reshape(-1).contiguous()
        self._tree: Any = wp.Mesh(wp.from_torch(self._vertices, dtype=wp.vec3f), wp.from_torch(self._faces))
        self._offset = _OFFSET * float(self._vertices.abs().max())

    def with_normals(self, normals: Float[Tensor, "V 3"]) -> RayMesh:
        """The same triangles with other unit shading normals, which may have a gradient."""
        turned = copy.copy(self)
        turned.mesh = replace(self.mesh, normals=normals)
        return turned

    def closest(self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Hits:
        """First hits of rays, from either side of a triangle."""
        from unmix_plugin.neumatex.tracing._ray_kernels import closest_kernel

        triangles = torch.empty(len(origins), dtype=torch.int64, device=self.device)
        barycentric = origins.new_empty((len(origins), 2))
        distances = origins.new_empty(len(origins))
        vec2, vec3 = (vector_type(size, torch.float32) for size in (2, 3))
        rays = [as_warp(values.contiguous(), vec3) for values in (origins, directions)]
        written = [as_warp(triangles), as_warp(barycentric, vec2), as_warp(distances)]
        arguments = [self._tree.id, _LONGEST, *rays, *written]
        launch(closest_kernel, len(origins), arguments, self.device)
        return Hits(triangles >= 0, triangles, barycentric, distances)

    def blocked(self, origins: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Whether rays meet the mesh at all."""
        return self.closest(origins, directions).found

    def seen(
        self, origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"]
    ) -> tuple[Bool[Tensor, " R"], SurfacePoints]:
        """Which rays meet the mesh, and where each of these does."""
        hits = self.closest(origins, directions)
        points = self.points(hits.select(hits.found), directions[hits.found])
        return hits.found, replace(points, eyes=origins[hits.found])

    def points(self, hits: Hits, directions: Float[Tensor, "N 3"]) -> SurfacePoints:
        """Surface points of hits, all of which are found.

        Args:
            hits: Of `closest`.
            directions: Of the rays that hit.
        """
        faces = self.mesh.faces[hits.triangles].long()
        u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
        a, b, c = self.mesh.vertices[faces].unbind(dim=1)
        # Edges from one corner lose less than three weighted corners do.
        positions = c + u * (a - c) + v * (b - c)
        geometric = torch.nn.functional.normalize(torch.linalg.cross(a - c, b - c), dim=-1)
        shading = (torch.stack([u, v, 1 - u - v], dim=1) * self.mesh.normals[faces]).sum(dim=1)
        shading = torch.nn.functional.normalize(shading, dim=-1)
        backside = (geometric * directions).sum(dim=-1, keepdim=True) > 0
        geometric = torch.where(backside, -geometric, geometric)
        # A triangle's own vertices may be wound against its normals: what faces the viewer decides.
        shading = torch.where((shading * geometric).sum(dim=-1, keepdim=True) < 0, -shading, shading)
        # Where interpolation turned normals away from the viewer, they are bent to be seen just so.
        cosines = -(shading * directions).sum(dim=-1, keepdim=True)
        bent = torch.nn.functional.normalize(shading - (_LEAST_COSINE - cosines) * directions, dim=-1)
        shading = torch.where(cosines < _LEAST_COSINE, bent, shading)
        return SurfacePoints(positions + self._offset * geometric, shading, geometric, -directions)


@dataclass(frozen=True)
class PixelHits:
    """Surface points behind the pixels of one image."""

    pixels: Int[Tensor, " K"]
    """Pixel of each ray, row * W + column, increasing; a pixel has up to n x n rays."""
    points: SurfacePoints
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
        return replace(self, pixels=self.pixels[rows], points=self.points.select(rows))


def pixel_hits(ray_mesh: RayMesh, cameras: Cameras, index: int, subpixels: int = 1) -> PixelHits:
    """The hits of one camera."""
    middles = [(place + 0.5) / subpixels for place in range(subpixels)]
    pixels, parts = [], []
    for offset in [(x, y) for y in middles for x in middles]:
        rays = cameras.to(ray_mesh.device).image_rays(index, offset)
        found, points = ray_mesh.seen(rays.origins, rays.directions)
        pixels.append(found.nonzero()[:, 0])
        parts.append(vars(points).values())
    points = SurfacePoints(*(torch.cat(part) for part in zip(*parts, strict=True)))
    hits = PixelHits(torch.cat(pixels), points, *cameras.size(index), subpixels**2)
    return hits.select(hits.pixels.argsort(stable=True))
