"""Procedural surfaces with known materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from unmix_plugin.neumatex.geometry.mesh import Mesh, mesh_of
from unmix_plugin.neumatex.materials.family import MaterialFamily
from unmix_plugin.neumatex.materials.layered import LayeredFamily
from unmix_plugin.neumatex.materials.pbr import PbrFamily


@dataclass(frozen=True)
class WavySurface:
    """Parameters that change smoothly over space, each in its own rhythm."""

    family: MaterialFamily

    def parameters(self, positions: Tensor) -> Tensor:
        index = torch.arange(self.family.num_parameters, device=positions.device)
        waves = torch.stack([(1.3 + index).sin(), (2.1 * index).cos(), (0.7 + 3.3 * index).sin()]) * 3
        return 0.5 + 0.45 * (positions @ waves.to(positions) + index).sin()


PBR, LAYERED = WavySurface(PbrFamily()), WavySurface(LayeredFamily())


def ball(subdivisions: int = 3) -> Mesh:
    """The unit sphere."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return mesh_of(torch.as_tensor(np.array(shape.vertices)), torch.as_tensor(np.array(shape.faces)))


def knot() -> Mesh:
    """A torus in [-1, 1]^3."""
    shape = trimesh.creation.torus(0.7, 0.3, major_sections=48, minor_sections=24)
    return mesh_of(torch.as_tensor(np.array(shape.vertices)), torch.as_tensor(np.array(shape.faces)))
