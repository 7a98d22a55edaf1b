"""The terms of what training makes smaller: their weights by name, and how each is computed.

`spectral`, `rgb`, `opacity` and `abundances` compare pixels (`LossTerm`, made in comparison.py); `sparsity` and
`certainty` the renderer sums along rays; `surface`, `near` and `normals` stand here. `poses` is of poses/refinement.py.

Where the views agree clearly on the surface that a pixel shows, light of its rays should come from there (Deng et al.
2022, Depth-supervised NeRF, with a plane sweep's distances in place of sparse points, and with a bound on what a wrong
one costs). Normals that a lamp's light teaches are guided by those of the densities: from afar the light alone goes
astray. Densities know roughly where a surface faces, light in the end knows better: so this fades out.

Notation: `R` pixels or rays, `S` visible samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.space import RayBundle, UnitSpace
from unmix_plugin.light.shading import LampShading
from unmix_plugin.presets import AlphaPreset
from unmix_plugin.settings import LossConfig
from unmix_plugin.spectral.evidence import bounded_square

_SPARSITY_PART = 0.25
"""Part of the training in which sparsity is asked for: later it would thin out surfaces."""
_CERTAINTY_WEIGHT = 1e-2
"""Weight, at the start of training, of the certainty of abundances. Before surfaces stand, most of what a ray sees is
haze of the commonest materials. Where the softmax grows sure of those, it has no gradient left, and a rare material is
never learnt. Source: Pereyra et al. 2017, Regularizing Neural Networks by Penalizing Confident Output Distributions."""
_CERTAINTY_PART = 0.5
"""Part of the training in which certainty costs something: later pure materials may be pure."""
_SURFACE_PART = 0.5
"""Part of the training in which known surfaces guide it: later they would hold back what is finer."""
_NORMALS_WEIGHT = 0.01
"""Weight, at the start of training, of the disagreement of normals that shading by a moving lamp learns with those of
the densities; it fades to the end."""
_FINAL_ABUNDANCES = 0.1
"""Factor on the weight of abundances at the end of training: once materials are found, what is left of their
disagreement with single pixels holds spectra back."""


def loss_weights(
    config: LossConfig, preset: AlphaPreset, progress: float, as_published: bool = False
) -> dict[str, float]:
    """Weight of each loss that counts when that part of the training is over, by name."""

    def fading(until: float) -> float:
        """From 1 at the start of training to 0 at `until`, slower and slower."""
        return max(1 - progress / until, 0.0) ** 2

    weights = {
        "spectral": config.spectral,
        "rgb": float(config.rgb),
        "opacity": preset.opacity_loss_weight,
        "sparsity": preset.sparsity_loss_weight * fading(_SPARSITY_PART),
        "surface": preset.surface_loss_weight * fading(_SURFACE_PART),
        "near": preset.near_loss_weight,
        "normals": _NORMALS_WEIGHT * fading(1.0),
        "certainty": _CERTAINTY_WEIGHT * fading(_CERTAINTY_PART),
        "abundances": config.abundances * _FINAL_ABUNDANCES**progress,
    }
    unknown_then = ("opacity", "sparsity", "surface", "near", "certainty") if as_published else ()
    return {name: x for name, x in weights.items() if x > 0 and name not in unknown_then}


@dataclass(frozen=True)
class LossTerm:
    """How far what is rendered of pixels is from what they should be: squared errors, bounded and weighted."""

    prediction: Float[Tensor, "R *channels"]
    target: Float[Tensor, "R *channels"]
    weight: tuple[Float[Tensor, "*"], ...] = ()
    """Factors of the squares, by channel or by pixel."""
    outlier: Float[Tensor, "R 1"] | None = None
    """Error from which on it counts in proportion instead of squared; None: squared however large."""
    of_pixel: Literal["mean", "sum"] = "mean"
    """Over the channels of a pixel."""

    def loss(self) -> Float[Tensor, ""]:
        """Mean over pixels."""
        errors = self.prediction - self.target
        squares = errors.square() if self.outlier is None else bounded_square(errors, self.outlier)
        for factor in self.weight:
            squares = factor * squares
        return squares.mean() if self.of_pixel == "mean" else squares.sum(dim=1).mean()


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


_NEAR_REACH = 1.2
"""Distance from a camera within which light counts as from near it, in distances of cameras from the middle of the box,
median over them."""
_MOST_CAMERAS = 64


def light_near_cameras(
    weights: Float[Tensor, "S"], positions: Float[Tensor, "S 3"], rays: RayBundle, space: UnitSpace
) -> Float[Tensor, ""]:
    """Mean over rays of the light that samples at positions of the unit cube send, by how near they are to any of the
    rays' cameras: (1 - d / r)^2 within r of the nearest.

    What is as well explained by something farther away, as a plain sky is, does not hang in the air between cameras.
    """
    views, order = rays.camera_indices.sort(stable=True)
    is_first = views.diff(prepend=views[:1] - 1) != 0
    cameras = rays.origins.detach()[order[is_first]]
    cameras = cameras[:: -(-len(cameras) // _MOST_CAMERAS)]
    reach = _NEAR_REACH * (cameras - space.box.aabb.mean(dim=0)).norm(dim=-1).median()
    nearest = torch.cdist(space.from_unit(positions), cameras).amin(dim=1)
    return (weights * (1 - nearest / reach).clamp(min=0).square()).sum() / max(len(rays), 1)


_ONE_OF = 8
"""Samples, of which one is evaluated in a step."""


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
