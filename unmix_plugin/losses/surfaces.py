"""How much of its light a ray takes from elsewhere than the surface that its pixel is known to show.

Notation: `R` rays, `S` samples that carry weight.

Source: Deng et al. 2022, Depth-supervised NeRF, with a plane sweep's distances in place of sparse points, and with a
bound on what a wrong one costs.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.space import UnitSpace

SURFACE_CELLS = 64.0
"""Along an edge of contracted space: the unit of the two bounds below."""
AT_SURFACE, OFF_SURFACE = 1.0, 3.0
"""Distance from the known place up to which all light counts, and beyond which none does."""


def surface_loss(
    outputs: dict[str, Tensor], surfaces: Float[Tensor, "pixels 3"], space: UnitSpace
) -> Float[Tensor, ""]:
    """`stray_light` of a training batch: the model's outputs, with one or more rays through each pixel."""
    rays_a_pixel = len(outputs["accumulation"]) // len(surfaces)
    each = surfaces.repeat_interleave(rays_a_pixel, dim=0)
    return stray_light(outputs["weights"], outputs["positions"], outputs["rays"], each, space)


def stray_light(
    weights: Float[Tensor, "S"],
    positions: Float[Tensor, "S 3"],
    ray_indices: Int[Tensor, "S"],
    surfaces: Float[Tensor, "R 3"],
    space: UnitSpace,
) -> Float[Tensor, ""]:
    """Mean over all rays of the share of light from elsewhere; 0 for rays whose surface isn't known.

    Args:
        weights: Share of its ray's light that each sample sends.
        positions: Of the samples, in the unit cube.
        ray_indices: Ray of each sample.
        surfaces: Known places, model space; NaN where unknown.
        space: That the positions are in.
    """
    is_known = ~surfaces.isnan().any(dim=-1)
    places = space.to_unit(surfaces.nan_to_num(0.0)).index_select(0, ray_indices)
    away = SURFACE_CELLS * (positions - places).norm(dim=-1)
    counted = ((OFF_SURFACE - away) / (OFF_SURFACE - AT_SURFACE)).clamp(0.0, 1.0)
    light = torch.zeros_like(surfaces[:, 0]).index_add(0, ray_indices, weights * counted)
    return torch.where(is_known, 1.0 - light, 0.0).mean()
