"""A bundle of rays: where each starts, where it points, which camera sent it.

Notation: `R` counts rays. A point on a ray is `origin + t * direction`, t in scene units since directions are unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class RayBundle:
    """Rays in model space, one row each."""

    origins: Float[Tensor, "R 3"]
    """Start points in scene units."""
    directions: Float[Tensor, "R 3"]
    """Unit vectors."""
    camera_indices: Int[Tensor, " R"]
    """Index of the camera that sent each ray, int64."""

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> RayBundle:
        """The rays at a slice, an index tensor (R',) or a boolean mask (R,)."""
        return RayBundle(self.origins[index], self.directions[index], self.camera_indices[index])

    def to(self, device: torch.device | str) -> RayBundle:
        """The same rays on another device."""
        return RayBundle(self.origins.to(device), self.directions.to(device), self.camera_indices.to(device))
