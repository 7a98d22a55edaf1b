"""What is composited along rays: one packed tensor, from which every picture of a view follows.

A ray's diffuse spectrum is linear in the endmembers, sum_i w_i E^T S_i a_i = E^T sum_i w_i S_i a_i. So a renderer
composites 2 + 2 K + J numbers a ray, and the B bands are made once a ray, by `materials.Materials`.

Notation: `K` endmembers, `J` spectra of the specular dictionary, `*rays` any leading axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

OCCUPIED_ACCUMULATION = 0.5
"""A ray shows a material only where at least this much of it ends on something."""


@dataclass(frozen=True)
class Coefficients:
    """Weighted sums over the samples of each ray."""

    packed: Float[Tensor, "*rays C"]
    """Accumulation, distance, K abundances, K scaled abundances, J specular coefficients."""
    num_endmembers: int
    """K."""

    @staticmethod
    def of(
        accumulation: Float[Tensor, "*rays"],
        distance: Float[Tensor, "*rays"],
        abundances: Float[Tensor, "*rays K"],
        scaled_abundances: Float[Tensor, "*rays K"],
        specular: Float[Tensor, "*rays J"],
    ) -> Coefficients:
        """Pack the parts, as the properties of the same names give them back."""
        columns = [accumulation[..., None], distance[..., None], abundances, scaled_abundances, specular]
        return Coefficients(torch.cat(columns, dim=-1), abundances.shape[-1])

    @property
    def accumulation(self) -> Float[Tensor, "*rays"]:
        """Opacity, [0, 1]."""
        return self.packed[..., 0]

    @property
    def distance(self) -> Float[Tensor, "*rays"]:
        """Sum of weight times distance along the ray, model units."""
        return self.packed[..., 1]

    @property
    def abundances(self) -> Float[Tensor, "*rays K"]:
        """a, summing to the accumulation."""
        return self.packed[..., 2 : 2 + self.num_endmembers]

    @property
    def scaled_abundances(self) -> Float[Tensor, "*rays K"]:
        """S a: what the endmembers are multiplied with."""
        return self.packed[..., 2 + self.num_endmembers : 2 + 2 * self.num_endmembers]

    @property
    def specular(self) -> Float[Tensor, "*rays J"]:
        """h u: what the specular dictionary is multiplied with; J = 0 without a view-dependent part."""
        return self.packed[..., 2 + 2 * self.num_endmembers :]

    @property
    def ray_distance(self) -> Float[Tensor, "*rays"]:
        """Mean distance along the ray to what it ends on, model units; 0 where nothing is."""
        return self.distance / self.accumulation.clamp(min=1e-6)

    @property
    def is_occupied(self) -> Bool[Tensor, "*rays"]:
        """Rays that show a material."""
        return self.accumulation > OCCUPIED_ACCUMULATION

    def with_light(self, scaled_abundances: Float[Tensor, "*rays K"]) -> Coefficients:
        """The same with more light of that mixture, and no more matter."""
        first = 2 + self.num_endmembers
        packed = self.packed.clone()
        packed[..., first : first + self.num_endmembers] += scaled_abundances
        return replace(self, packed=packed)

    def map(self, function: Callable[[Tensor], Tensor]) -> Coefficients:
        """The same after a change of leading axes, device or dtype."""
        return replace(self, packed=function(self.packed))

    def unflatten(self, height: int, width: int) -> Coefficients:
        """Rays in rows as an image."""
        return self.map(lambda packed: packed.unflatten(0, (height, width)))

    def flatten(self) -> Coefficients:
        """An image as rays in rows."""
        return self.map(lambda packed: packed.flatten(0, -2))

    @staticmethod
    def concatenate(parts: Sequence[Coefficients]) -> Coefficients:
        """The rays of all parts, in order."""
        return Coefficients(torch.cat([part.packed for part in parts]), parts[0].num_endmembers)
