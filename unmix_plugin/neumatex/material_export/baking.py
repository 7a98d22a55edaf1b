"""The material of every texel of an atlas.

Notation: `T` texels in charts, `P` parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.material_export.atlas import Atlas, unwrap
from unmix_plugin.neumatex.material_export.texels import Texels, texels_of
from unmix_plugin.neumatex.surface import Surface

_CHUNK = 1 << 17


@dataclass(frozen=True)
class BakedMaterial:
    """A surface's parameters at the texels of an atlas."""

    atlas: Atlas
    texels: Texels
    parameters: Float[Tensor, "T P"]
    """[0, 1], on the CPU."""

    def texture(self, values: Tensor) -> np.ndarray:
        """Values of texels (T, C) as a texture (S, S, C), float32, filled beyond the charts."""
        return self.texels.texture(values.detach().cpu().numpy().astype(np.float32))


@torch.no_grad()
def bake(mesh: Mesh, surface: Surface, texture_size: int) -> BakedMaterial:
    """Unwrap a mesh and look up the surface's parameters at each texel.

    Args:
        mesh: Model space.
        surface: Its materials.
        texture_size: Width and height of the textures, texels.
    Raises:
        ConfigError: xatlas is not installed, or the mesh does not fit into the texture.
    """
    atlas = unwrap(mesh, texture_size)
    texels = texels_of(atlas, texture_size)
    faces = atlas.vertices[atlas.faces]
    positions = texels.of_corners(mesh.vertices.cpu().double().numpy(), faces)
    points = torch.from_numpy(positions).float().to(mesh.vertices.device)
    parameters = torch.cat([surface.parameters(part).cpu() for part in points.split(_CHUNK)])
    return BakedMaterial(atlas, texels, parameters)
