"""The axis-aligned box of model space outside which nothing is modelled."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class SceneBox:
    """Axis-aligned box of positive volume."""

    aabb: Float[Tensor, "2 3"]
    """Smallest corner, largest corner, in scene units."""

    def __post_init__(self) -> None:
        low, high = self.aabb[0].tolist(), self.aabb[1].tolist()
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"aabb must have its smaller corner first; got {low} and {high}")

    @property
    def size(self) -> Float[Tensor, "3"]:
        """Edge lengths in scene units."""
        return self.aabb[1] - self.aabb[0]

    def normalise(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Map the box onto [0, 1]^3; points outside land outside."""
        return (points - self.aabb[0]) / (self.aabb[1] - self.aabb[0])

    def contains(self, points: Float[Tensor, "*points 3"]) -> Bool[Tensor, "*points"]:
        """True for points inside or on the surface."""
        return ((points >= self.aabb[0]) & (points <= self.aabb[1])).all(dim=-1)

    def intersect(
        self, origins: Float[Tensor, "*rays 3"], directions: Float[Tensor, "*rays 3"]
    ) -> tuple[Float[Tensor, "*rays"], Float[Tensor, "*rays"]]:
        """Distances at which rays enter and leave the box (slab method).

        Returns:
            t_near, t_far in units of the direction's length, 0 <= t_near <= t_far: t_near is 0 for an origin inside,
            and a ray that misses the box has t_near == t_far, a stretch of no length.
        """
        # A component of exactly 0 would give 0 * inf = nan on a face; 1e-20 moves the crossing beyond any scene.
        tiny = torch.full_like(directions, 1e-20)
        safe = torch.where(directions.abs() < 1e-20, tiny, directions)
        to_low, to_high = (self.aabb[0] - origins) / safe, (self.aabb[1] - origins) / safe
        t_near = torch.minimum(to_low, to_high).amax(dim=-1).clamp_min(0.0)
        t_far = torch.maximum(to_low, to_high).amin(dim=-1)
        misses = t_far <= t_near
        t_near = torch.where(misses, torch.zeros_like(t_near), t_near)
        return t_near, torch.where(misses, t_near, t_far)

    def to(self, device: torch.device | str) -> SceneBox:
        """The same box on another device."""
        return SceneBox(self.aabb.to(device))
