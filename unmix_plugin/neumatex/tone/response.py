"""A camera's response, learnt with the materials: how the numbers of its pictures grow with light.

The response is given by the logarithm of its slope, which is a mean and a few principal components. So whatever the
coefficients are, it increases from 0 to 1. The components come from a family of curves made here (powers, logarithms,
S-shaped ones), since the measured curves of Grossberg and Nayar (2004, EMoR) can't be shipped with this package.

Notation: `S` steps of the curve, `F` curves of the family, `K` coefficients.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

NUM_STEPS = 256
NUM_COEFFICIENTS = 6
MAX_STOPS = 8.0
"""Exposure that can be learnt, either way."""


class CameraResponse(nn.Module):
    """One increasing curve for all colours, and the exposure before it."""

    mean: Tensor
    components: Tensor

    def __init__(self) -> None:
        super().__init__()
        mean, components = response_basis()
        self.register_buffer("mean", mean.clone())
        self.register_buffer("components", components.clone())
        self.coefficients = nn.Parameter(torch.zeros(NUM_COEFFICIENTS))
        self.exposure_stops = nn.Parameter(torch.zeros(()))

    def curve(self) -> Float[Tensor, "S_plus_1"]:
        """The response at (i / S)^2 of full exposure, from 0 to 1."""
        increments = (self.mean + self.coefficients @ self.components).softmax(dim=0)
        return torch.cat([increments.new_zeros(1), increments.cumsum(dim=0)])

    def forward(self, light: Float[Tensor, "*pixels C"]) -> Float[Tensor, "*pixels C"]:
        """Numbers in [0, 1] of linear light; no gradient where light is beyond white."""
        stops = self.exposure_stops.clamp(-MAX_STOPS, MAX_STOPS)
        exposed = (light * torch.exp2(stops)).clamp(1e-8, 1)
        curve = self.curve()
        place = exposed.sqrt() * NUM_STEPS
        step = place.detach().long().clamp(max=NUM_STEPS - 1)
        low, high = (step / NUM_STEPS).square(), ((step + 1) / NUM_STEPS).square()
        part = (exposed - low) / (high - low)
        return curve[step] + (curve[step + 1] - curve[step]) * part


@lru_cache(maxsize=1)
def response_basis() -> tuple[Float[Tensor, " S"], Float[Tensor, "K S"]]:
    """Mean and principal components of the logarithm of the steps of all curves of the family.

    A component is scaled by its spread, so that coefficients of about 1 are usual.
    """
    logs = curve_family().diff(dim=1).clamp(min=1e-12).log()
    mean = logs.mean(dim=0)
    _, spreads, axes = torch.linalg.svd(logs - mean, full_matrices=False)
    scale = spreads[:NUM_COEFFICIENTS, None] / len(logs) ** 0.5
    return mean.float(), (scale * axes[:NUM_COEFFICIENTS]).float()


def curve_family() -> Float[Tensor, "F S_plus_1"]:
    """Responses at (i / S)^2 of full exposure, float64: powers, logarithms, S-shaped ones, and powers of these."""
    light = torch.linspace(0, 1, NUM_STEPS + 1, dtype=torch.float64).square()
    gammas = torch.linspace(0.3, 1.4, 12, dtype=torch.float64)
    bends = torch.logspace(-0.5, 2.5, 10, dtype=torch.float64)
    steepness = torch.linspace(0.7, 1.8, 6, dtype=torch.float64)
    middles = torch.tensor([0.1, 0.18, 0.3, 0.5, 1.0], dtype=torch.float64)
    powers = [light**gamma for gamma in gammas]
    logs = [
        (torch.log1p(bend * light) / torch.log1p(bend)) ** gamma for bend in bends for gamma in gammas[3:9:2]
    ]
    shaped = [light**n / (light**n + middle**n) * (1 + middle**n) for n in steepness for middle in middles]
    return torch.stack([*powers, *logs, *shaped])
