"""From materials at points to planes: the planes that the readers read back best.

Notation: `B` objects, `N` points, `P` parameters, `C` channels and `R` texels of a plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.triplane import NUM_CHANNELS, Readers, point_features

RESOLUTION = 32
"""R of fitted planes: cells that hold several points each, whose errors average out."""
_RATE = 0.05
_SHRINKAGE = 1e-4
"""Pulls texels that hardly a point reads to 0."""


@dataclass(frozen=True)
class Estimates:
    """What is said of points of objects."""

    positions: Float[Tensor, "B N 3"]
    parameters: Float[Tensor, "B N P"]
    log_variance: Float[Tensor, "B N P"]


def fit_loss(readers: Readers, planes: Float[Tensor, "B 3 C R R"], estimates: Estimates) -> Float[Tensor, ""]:
    """How far the planes are from what is said of points: errors count by how sure it is, and log-variances too."""
    features = torch.stack([point_features(*pair) for pair in zip(planes, estimates.positions, strict=True)])
    features, said = features.flatten(0, 1), estimates.log_variance.flatten(0, 1)
    error = readers.material(features) - estimates.parameters.flatten(0, 1)
    # Parameters that are known to 0.02 or better count the same: beyond that a few points would decide all.
    certain = torch.exp(-0.5 * said.clamp(min=-8.0))
    unsure = readers.log_variance(features) - said
    return (
        (error.square() * certain).mean()
        + 0.02 * unsure.square().mean()
        + _SHRINKAGE * planes.square().mean()
    )


def fit_planes(readers: Readers, estimates: Estimates, steps: int = 120) -> Float[Tensor, "B 3 C R R"]:
    """Planes of objects, fitted from 0; the readers stay as they are."""
    with torch.enable_grad():
        count = len(estimates.positions)
        planes = torch.zeros(count, 3, NUM_CHANNELS, RESOLUTION, RESOLUTION, requires_grad=True)
        optimiser = torch.optim.Adam([planes], lr=_RATE, eps=1e-12)
        for _ in range(steps):
            (gradient,) = torch.autograd.grad(count * fit_loss(readers, planes, estimates), planes)
            planes.grad = gradient
            optimiser.step()
    return planes.detach()
