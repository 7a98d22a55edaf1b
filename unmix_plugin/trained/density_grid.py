"""The field of a trained scene on a regular grid, slice by slice: density, and what there is of each endmember.

Only cells that are rendered are asked: elsewhere the field was never trained, and what it says there is nothing.

Notation: `X x Y x Z` grid points, `P` points, `K` endmembers. Model space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.trained_scene import TrainedScene

_RESOLUTIONS = (8, 1024)
_CHUNK = 1 << 16


@dataclass(frozen=True)
class GridPoints:
    """Points of a regular grid over a scene box; the outermost lie on its faces, but for a fraction of a cell."""

    origin: Float32[np.ndarray, "3"]
    """First point."""
    cell: float
    """Distance of neighbours along each axis."""
    shape: tuple[int, int, int]
    """Points along x, y and z."""

    @staticmethod
    def over(aabb: Float[Tensor, "2 3"], resolution: int) -> GridPoints:
        """A grid with `resolution` cells along the longest edge of a box.

        Raises:
            ConfigError: fewer than 8 cells, or more than 1024.
        """
        low, high = _RESOLUTIONS
        if not low <= resolution <= high:
            raise ConfigError(
                f"--resolution is {resolution}; choose {low} to {high} cells along the longest edge"
            )
        corners = aabb.detach().cpu().double().numpy()
        size = corners[1] - corners[0]
        cell = float(size.max()) / resolution
        x, y, z = (int(np.floor(edge / cell + 1e-6)) + 1 for edge in size)
        return GridPoints(corners[0].astype(np.float32), cell, (x, y, z))

    def slice_points(self, index: int) -> Float[Tensor, "Y Z 3"]:
        """Points of the slice at `index` along x."""
        _, num_y, num_z = self.shape
        cells = torch.cartesian_prod(torch.tensor([index]), torch.arange(num_y), torch.arange(num_z))
        points = torch.from_numpy(self.origin).double() + self.cell * cells
        return points.float().view(num_y, num_z, 3)


@torch.no_grad()
def sample_slice(
    scene: TrainedScene, points: Float[Tensor, "Y Z 3"]
) -> tuple[Float32[np.ndarray, "Y Z"], Float32[np.ndarray, "Y Z K"]]:
    """Densities per model unit, and abundances, which sum to 1; both 0 in cells that are never rendered."""
    flat = points.flatten(0, 1).to(scene.device)
    densities = torch.zeros(len(flat), device=scene.device)
    abundances = torch.zeros(len(flat), len(scene.materials.names), device=scene.device)
    for chosen in scene.renderer.is_occupied(flat).nonzero()[:, 0].split(_CHUNK):
        densities[chosen], features = scene.field.get_density(flat[chosen])
        abundances[chosen] = scene.field.abundances_of(features)
    shape = points.shape[:2]
    return densities.cpu().unflatten(0, shape).numpy(), abundances.cpu().unflatten(0, shape).numpy()


@torch.no_grad()
def sample_densities(scene: TrainedScene, positions: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """Densities per model unit of any points of the box, 0 in cells that are never rendered; on the CPU."""
    flat = positions.to(scene.device)
    densities = torch.zeros(len(flat), device=scene.device)
    for chosen in scene.renderer.is_occupied(flat).nonzero()[:, 0].split(_CHUNK):
        densities[chosen] = scene.field.get_density(flat[chosen])[0]
    return densities.cpu()


def may_be_solid(scene: TrainedScene, points: Float[Tensor, "*grid 3"]) -> Bool[Tensor, "*grid"]:
    """Which points lie where anything may be: not in the space that was found to be empty before training; CPU."""
    return scene.renderer.is_reachable(points.to(scene.device)).cpu()
