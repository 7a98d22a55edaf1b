"""Rays, the box that holds the scene, and the unit cube that grids divide.

Notation: `R` rays; a point on a ray is `origin + t * direction`, t in scene units since directions are unit vectors.

An unbounded world is contracted around the box, whose inside stays as it is. With u the coordinates in which the box's
longest edge runs from -1 to 1, and r = max |u|: where r <= 1 nothing happens, elsewhere u becomes (2 - 1/r) u / r, so
that infinity lies at r = 2. The cube of edge 4 that this fills is scaled to the unit cube; the maximum norm leaves no
corner of it empty.

Source: Barron et al. 2022, mip-NeRF 360, eq. 10, with the norm of Tancik et al. 2023, Nerfstudio, section 4.2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
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
    pixel_coords: Float[Tensor, "R 2"] | None = None
    """x and y in the image that each ray passes, pixels; None where no image is known."""
    offsets: Float[Tensor, "R 2"] | None = None
    """The same from the optical axis, to the right and downwards at distance 1, without the lens's distortion."""

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> RayBundle:
        """The rays at a slice, an index tensor (R',) or a boolean mask (R,)."""
        return self._map(lambda column: column[index])

    def at(self, distances: Float[Tensor, " R"]) -> Float[Tensor, "R 3"]:
        """Points of the rays so far from their origins."""
        return self.origins + distances[:, None] * self.directions

    @staticmethod
    def join(bundles: Sequence[RayBundle]) -> RayBundle:
        """The rays of several bundles that know the same of their rays, one after the other."""
        if len(bundles) == 1:
            return bundles[0]
        columns: Any = [[getattr(bundle, field.name) for bundle in bundles] for field in fields(RayBundle)]
        joined: list[Any] = [None if column[0] is None else torch.cat(column) for column in columns]
        return RayBundle(*joined)

    def to(self, device: torch.device | str) -> RayBundle:
        """The same rays on another device."""
        return self._map(lambda column: column.to(device))

    def _map(self, change: Callable[[Tensor], Tensor]) -> RayBundle:
        columns = (getattr(self, field.name) for field in fields(self))
        changed: list[Any] = [None if column is None else change(column) for column in columns]
        return RayBundle(*changed)


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


_SPAN = 4.0
"""Edge of the contracted world in units of u."""


def contract(points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """All of space into the cube from -2 to 2; points of the cube from -1 to 1 stay where they are."""
    radius = points.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
    return points * ((2.0 - 1.0 / radius) / radius)


def uncontract(points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """The inverse of `contract`; points on or beyond the faces of its cube are taken for ones just inside."""
    inside = points.clamp(-2.0 + 1e-6, 2.0 - 1e-6)
    radius = inside.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
    return inside / (radius * (2.0 - radius))


def contracted_unit(points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """`contract`, with its cube scaled to the unit cube."""
    return contract(points) / _SPAN + 0.5


@dataclass(frozen=True)
class UnitSpace:
    """How model space maps to the unit cube that grids divide."""

    box: SceneBox
    is_unbounded: bool = False
    """Whether the cube holds all of space, contracted around the box's centre, or the box alone."""

    @cached_property
    def centre(self) -> Float[Tensor, "3"]:
        """Middle of the box, model units."""
        return self.box.aabb.mean(dim=0)

    @cached_property
    def half_edge(self) -> Float[Tensor, ""]:
        """Half of the box's longest edge, model units: what r = 1 is."""
        return self.box.size.max() / 2

    @property
    def shortest_edge(self) -> Float[Tensor, ""]:
        """Of what the unit cube holds, model units; far from the box a unit there is longer."""
        return _SPAN * self.half_edge if self.is_unbounded else self.box.size.min()

    def centred(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Coordinates u."""
        return (points - self.centre) / self.half_edge

    def to_unit(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Model space to the unit cube."""
        if not self.is_unbounded:
            return self.box.normalise(points)
        return contracted_unit(self.centred(points))

    def from_unit(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """The inverse of `to_unit`."""
        if not self.is_unbounded:
            return points * self.box.size + self.box.aabb[0]
        return uncontract((points - 0.5) * _SPAN) * self.half_edge + self.centre

    def contains(self, points: Float[Tensor, "*points 3"]) -> Tensor:
        """Points that are modelled: those in the box, or all; bool (*points)."""
        everywhere = torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
        return everywhere if self.is_unbounded else self.box.contains(points)
