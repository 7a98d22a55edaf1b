"""A bundle of rays: where each starts, where it points, which camera sent it.

Notation: `R` counts rays. A point on a ray is `origin + t * direction`, t in scene units since directions are unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

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
    axes: Float[Tensor, "R 3"] | None = None
    """Where the camera of each ray looked when it was taken, unit vectors; None where no camera is known."""
    image_y: Float[Tensor, " R"] | None = None
    """Height in the image that each ray passes, pixels; None where no image is known."""

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> RayBundle:
        """The rays at a slice, an index tensor (R',) or a boolean mask (R,)."""
        return self._map(lambda values: values[index])

    @staticmethod
    def join(bundles: Sequence[RayBundle]) -> RayBundle:
        """The rays of several bundles that know the same of their rays, one after the other."""
        named = {
            field.name: [getattr(bundle, field.name) for bundle in bundles] for field in fields(RayBundle)
        }
        parts: dict[str, Any] = {
            name: None if values[0] is None else torch.cat(values) for name, values in named.items()
        }
        return RayBundle(**parts)

    def to(self, device: torch.device | str) -> RayBundle:
        """The same rays on another device."""
        return self._map(lambda values: values.to(device))

    def _map(self, change: Callable[[Tensor], Tensor]) -> RayBundle:
        return RayBundle(
            change(self.origins),
            change(self.directions),
            change(self.camera_indices),
            None if self.axes is None else change(self.axes),
            None if self.image_y is None else change(self.image_y),
        )
