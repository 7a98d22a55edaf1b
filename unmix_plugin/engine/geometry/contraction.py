"""From an unbounded world to the unit cube: space around the scene box is contracted, the box itself is not.

Notation: `P` points; u are coordinates in which the box's longest edge runs from -1 to 1, r = max |u| (the maximum
norm). Where r <= 1, nothing happens; elsewhere u becomes (2 - 1/r) u / r, so that infinity lies at r = 2. The cube of
edge 4 that this fills is scaled to the unit cube. The maximum norm leaves no corner of that cube empty.

Source: Barron et al. 2022, mip-NeRF 360, eq. 10, with the norm of Tancik et al. 2023, Nerfstudio, section 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.scene_box import SceneBox

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

    @property
    def half_edge(self) -> Float[Tensor, ""]:
        """Half of the box's longest edge, model units: what r = 1 is."""
        return self.box.size.max() / 2

    @property
    def shortest_edge(self) -> Float[Tensor, ""]:
        """Of what the unit cube holds, model units; far from the box a unit there is longer."""
        return _SPAN * self.half_edge if self.is_unbounded else self.box.size.min()

    def centred(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Coordinates u."""
        return (points - self.box.aabb.mean(dim=0)) / self.half_edge

    def to_unit(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Model space to the unit cube."""
        if not self.is_unbounded:
            return self.box.normalise(points)
        return contracted_unit(self.centred(points))

    def from_unit(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """The inverse of `to_unit`."""
        if not self.is_unbounded:
            return points * self.box.size + self.box.aabb[0]
        return uncontract((points - 0.5) * _SPAN) * self.half_edge + self.box.aabb.mean(dim=0)

    def contains(self, points: Float[Tensor, "*points 3"]) -> Tensor:
        """Points that are modelled: those in the box, or all; bool (*points)."""
        everywhere = torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
        return everywhere if self.is_unbounded else self.box.contains(points)
