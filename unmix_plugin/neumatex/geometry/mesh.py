"""A triangle mesh with shading normals.

Notation: `V` vertices, `F` triangles. Triangles are counter-clockwise seen from outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Mesh:
    """Triangles of one object; `mesh_of` makes one from vertices and faces."""

    vertices: Float[Tensor, "V 3"]
    """Positions; in world units as read, in [-1, 1] in model space."""
    faces: Int[Tensor, "F 3"]
    """Vertices of each triangle, int32."""
    normals: Float[Tensor, "V 3"]
    """Unit shading normals, outward."""
    uv: Float[Tensor, "V 2"] | None = None
    """Texture coordinates of the file, v upwards; None if it has none."""

    def transformed(self, scale: float, offset: Float[Tensor, "3"]) -> Mesh:
        """The mesh with vertices `scale * (vertices + offset)`, scale > 0."""
        return replace(self, vertices=scale * (self.vertices + offset.to(self.vertices)))

    def with_y_upwards(self) -> Mesh:
        """The mesh turned by 90 degrees about x, so that its y axis points along z, as the world's upward axis does."""
        vertices, normals = (
            torch.stack([v[:, 0], -v[:, 2], v[:, 1]], dim=1) for v in (self.vertices, self.normals)
        )
        return replace(self, vertices=vertices.contiguous(), normals=normals.contiguous())

    def to(self, device: torch.device | str) -> Mesh:
        """The same mesh on another device."""
        uv = None if self.uv is None else self.uv.to(device)
        return Mesh(self.vertices.to(device), self.faces.to(device), self.normals.to(device), uv)

    def corners(self) -> Float[Tensor, "F 3 3"]:
        """Positions of each triangle's vertices."""
        return self.vertices[self.faces.long()]

    def to_model_space(self) -> tuple[float, Float[Tensor, "3"]]:
        """Scale and offset for `transformed` that centre the bounding box and give its longest half edge length 1."""
        low, high = self.vertices.min(dim=0).values, self.vertices.max(dim=0).values
        return 2.0 / float((high - low).max()), -(low + high) / 2


def mesh_of(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "V 3"] | None = None,
    uv: Float[Tensor, "V 2"] | None = None,
) -> Mesh:
    """A mesh of float32 vertices, with area-weighted normals where none are given."""
    vertices, faces = vertices.float().contiguous(), faces.int().contiguous()
    if normals is None:
        normals = area_weighted_normals(vertices, faces)
    return Mesh(vertices, faces, torch.nn.functional.normalize(normals.float(), dim=-1), uv)


def area_weighted_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit normals of vertices: means over their triangles, weighted by area; +z where they cancel."""
    a, b, c = vertices.double()[faces.long()].unbind(dim=1)
    doubled_areas = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(vertices, dtype=torch.float64)
    sums.index_add_(0, faces.reshape(-1).long(), doubled_areas.repeat_interleave(3, dim=0))
    lengths = sums.norm(dim=-1, keepdim=True)
    upwards = sums.new_tensor((0.0, 0.0, 1.0))
    return torch.where(lengths > 1e-30, sums / lengths.clamp(min=1e-30), upwards).float()
