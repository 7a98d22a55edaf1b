"""Texture coordinates: a mesh cut into charts that lie side by side in the unit square.

Notation: `V` vertices of the mesh, `U` of the cut one (a vertex on a seam is there once a chart), `F` triangles.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.material_export.charts import chart_labels, chart_uv

_PADDING = 4
"""Texels between charts, so that linear interpolation and two levels of smaller copies don't mix them."""

_TRIES = 6


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
        Packing by xatlas (Young).
    """
    if importlib.util.find_spec("xatlas") is None:
        raise ConfigError(
            "texture coordinates need the package xatlas, which is not installed: pip install xatlas"
        )
    positions, faces = mesh.vertices.cpu().double().numpy(), mesh.faces.cpu().long().numpy()
    charts, axes = chart_labels(positions, faces)
    # A vertex is there once for each chart that it has a part in.
    keys, corners = np.unique(charts[:, None].astype(np.int64) * len(positions) + faces, return_inverse=True)
    cut, vertices = corners.reshape(faces.shape), keys % len(positions)
    axis_of_chart = np.zeros(charts.max() + 1, dtype=np.int64)
    axis_of_chart[charts] = axes
    flat = chart_uv(positions[vertices], axis_of_chart[keys // len(positions)]).astype(np.float32)
    packer = _packed(flat, cut, charts, texture_size)
    order, packed, uv = packer[0]
    return Atlas(vertices[order.astype(np.int64)], packed.astype(np.int64), uv.astype(np.float32))


def _packed(flat: np.ndarray, cut: np.ndarray, charts: np.ndarray, texture_size: int) -> Any:
    """The packed charts; xatlas only estimates how large they may be, so that what it finds is scaled to fit.

    Raises:
        ConfigError: the space between the charts leaves no room for them.
    """
    import xatlas

    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = texture_size, _PADDING, True
    for _ in range(_TRIES):
        packer = xatlas.Atlas()
        packer.add_uv_mesh(flat, cut.astype(np.uint32), charts[:, None].astype(np.uint32))
        packer.generate(xatlas.ChartOptions(), packing)
        side = max(packer.width, packer.height)
        if packer.atlas_count == 1 and side <= texture_size:
            return packer
        packing.resolution = 0
        packing.texels_per_unit = 0.98 * packer.texels_per_unit * texture_size / side
    raise ConfigError(
        f"the {charts.max() + 1} charts of {len(cut)} triangles don't fit into a texture of {texture_size} x "
        f"{texture_size}; choose a larger --texture-size or simplify the mesh"
    )
