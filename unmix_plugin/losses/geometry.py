"""Losses that know of surfaces: light from elsewhere than a known one, and normals that lean on densities.

Where the views agree clearly on the surface that a pixel shows, light of its rays should come from there (Deng et al.
2022, Depth-supervised NeRF, with a plane sweep's distances in place of sparse points, and with a bound on what a wrong
one costs). Normals that a lamp's light teaches are guided by those of the densities: from afar the light alone goes
astray. Densities know roughly where a surface faces, light in the end knows better: so this fades out.

Notation: `R` rays, `S` visible samples.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.space import UnitSpace
from unmix_plugin.light.shading import LampShading

_SURFACE_CELLS = 64.0
"""Along an edge of contracted space: the unit of the two bounds below."""
_AT_SURFACE, _OFF_SURFACE = 1.0, 3.0
"""Distance from the known place up to which all light counts, and beyond which none does."""


def stray_light(
    weights: Float[Tensor, "S"],
    positions: Float[Tensor, "S 3"],
    ray_indices: Int[Tensor, "S"],
    surfaces: Float[Tensor, "R 3"],
    space: UnitSpace,
) -> Float[Tensor, ""]:
    """Mean over all rays of the share of light from elsewhere than their surfaces (model space, NaN where unknown); 0
    for rays whose surface isn't known. Each sample, at a position of the unit cube, sends a weight of its ray's light.
    """
    is_known = ~surfaces.isnan().any(dim=-1)
    places = space.to_unit(surfaces.nan_to_num(0.0)).index_select(0, ray_indices)
    away = _SURFACE_CELLS * (positions - places).norm(dim=-1)
    counted = ((_OFF_SURFACE - away) / (_OFF_SURFACE - _AT_SURFACE)).clamp(0.0, 1.0)
    light = torch.zeros_like(surfaces[:, 0]).index_add(0, ray_indices, weights * counted)
    return torch.where(is_known, 1.0 - light, 0.0).mean()


_ONE_OF = 8
"""Samples, of which one is looked at in a step."""


def normals_error(
    get_density: Callable[[Tensor], tuple[Tensor, Tensor]],
    shading: LampShading,
    positions: Float[Tensor, "S 3"],
    weights: Float[Tensor, "S"],
    generator: torch.Generator | None,
) -> Float[Tensor, ""]:
    """Mean of 1 - n . m over some samples in model space, by weight: n the learnt normals, m against the slope of the
    log density.

    Source: Verbin et al. 2022, Ref-NeRF, on predicted normals; there as a squared distance, which is twice as much.
    """
    device = positions.device if generator is None else generator.device
    chosen = torch.randperm(len(positions), generator=generator, device=device)
    chosen = chosen[: -(-len(positions) // _ONE_OF)].to(positions.device)
    at, shares = positions[chosen].requires_grad_(), weights.detach()[chosen]
    densities, features = get_density(at)
    logs = densities.clamp(min=1e-20).log().sum()
    (slope,) = torch.autograd.grad(logs, at, retain_graph=True)
    agreement = (shading.surface(features)[0] * normalize(-slope, dim=1)).sum(dim=1)
    return (shares * (1 - agreement)).sum() / shares.sum().clamp(min=1e-6)
