"""Texture coordinates: a mesh cut into charts that lie side by side in the unit square.

Notation: `V` vertices of the mesh, `U` of the cut one (a vertex on a seam is there once a chart), `F` triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.geometry.mesh import Mesh

_PADDING = 4
"""Texels between charts, so that linear interpolation and two levels of smaller copies don't mix them."""


@dataclass(frozen=True)
class Atlas:
    """A mesh cut open."""

    vertices: Int64[np.ndarray, " U"]
    """The vertex of the mesh that each vertex is a copy of."""
    faces: Int64[np.ndarray, "F 3"]
    """Vertices of each triangle, in the mesh's order of triangles."""
    uv: Float32[np.ndarray, "U 2"]
    """Texture coordinates as glTF has them: u to the right, v downwards, [0, 1]."""


def unwrap(mesh: Mesh, texture_size: int) -> Atlas:
    """Cut a mesh into charts and pack them.

    Args:
        mesh: Any.
        texture_size: Width and height of the textures, texels.
    Raises:
        ConfigError: xatlas is not installed, or the charts don't fit into a texture of this size.
    Source:
        xatlas (Young), after Ray and Levy's chart growing and thekla_atlas.
    """
    try:
        import xatlas
    except ImportError as error:
        raise ConfigError(
            "texture coordinates need the package xatlas, which is not installed: pip install xatlas"
        ) from error
    cutter = xatlas.Atlas()
    positions = mesh.vertices.cpu().numpy().astype(np.float32)
    cutter.add_mesh(positions, mesh.faces.cpu().numpy().astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = texture_size, _PADDING, True
    cutter.generate(xatlas.ChartOptions(), packing)
    if cutter.atlas_count != 1:
        raise ConfigError(
            f"the {len(mesh.faces)} triangles need {cutter.atlas_count} textures of {texture_size} x {texture_size}; "
            "choose a larger --texture-size or simplify the mesh"
        )
    vertices, faces, uv = cutter[0]
    return Atlas(vertices.astype(np.int64), faces.astype(np.int64), uv.astype(np.float32))
