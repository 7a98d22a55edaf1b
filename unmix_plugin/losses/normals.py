"""Normals that a lamp's light teaches are guided by those of the densities: from afar the light alone goes astray.

Densities know roughly where a surface faces, light in the end knows better: so this fades out while training goes on.

Notation: `S` samples that carry weight.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.light.shading import LampShading

_ONE_OF = 8
"""Samples, of which one is looked at in a step."""


def normals_error(
    get_density: Callable[[Tensor], tuple[Tensor, Tensor]],
    shading: LampShading,
    positions: Float[Tensor, "S 3"],
    weights: Float[Tensor, "S"],
    generator: torch.Generator | None,
) -> Float[Tensor, ""]:
    """Mean of 1 - n . m over some samples, by weight: n the learnt normals, m against the slope of the log density.

    Args:
        get_density: From positions to densities and geometry features.
        shading: Whose normals are guided.
        positions: Model space, without gradients.
        weights: Share of its ray's light that each sample contributes.
        generator: Chooses the samples.

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
