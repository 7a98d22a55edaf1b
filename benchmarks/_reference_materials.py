"""Materials that Mitsuba has in just the same form: Lambert, and a GGX conductor that reflects one colour.

Mitsuba's conductor masks light and eye apart, ours together; here it is as there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from unmix_plugin.neumatex.tracing.families import MaterialFamily
from unmix_plugin.neumatex.tracing.microfacet import (
    distribution,
    half_vectors,
    reflection_density,
    sample_reflections,
)


class ConductorBlend(MaterialFamily):
    """Parameters: colour (0 to 2), GGX width alpha (3), share of the conductor (4)."""

    num_parameters = 5
    num_colours = 3

    def evaluate(self, parameters: Tensor, wi: Tensor, wo: Tensor) -> Tensor:
        """Reflectance, 1/sr."""
        alpha, share = parameters[:, 3:4], parameters[:, 4:]
        n_i, n_o = wi[:, 2:], wo[:, 2:]
        lobe = distribution(alpha.T, half_vectors(wi.T, wo.T)).T * _masked(alpha, n_i) * _masked(alpha, n_o)
        lobe = lobe / (4 * n_i * n_o).clamp(min=1e-12)
        value = parameters[:, :3] * ((1 - share) / math.pi + share * lobe)
        return torch.where((n_i > 0) & (n_o > 0), value, 0.0)

    def sample(self, parameters: Tensor, wo: Tensor, uniforms: Tensor) -> Tensor:
        """Directions by one of the two parts."""
        glossy = sample_reflections(parameters[:, 3], wo.T, uniforms[:, :2].T).T
        azimuth, radius = 2 * math.pi * uniforms[:, 0], uniforms[:, 1].sqrt()
        z = (1 - uniforms[:, 1]).sqrt()
        diffuse = torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=-1)
        return torch.where(uniforms[:, 2:] < parameters[:, 4:], glossy, diffuse)

    def density(self, parameters: Tensor, wi: Tensor, wo: Tensor) -> Tensor:
        """Of `sample`, 1/sr."""
        glossy = reflection_density(parameters[:, 3:4].T, wi.T, wo.T)[0]
        diffuse = wi[:, 2].clamp(min=0.0) / math.pi
        return torch.lerp(diffuse, glossy, parameters[:, 4])

    def base_colour(self, parameters: Tensor) -> Tensor:
        """The colour."""
        return parameters[:, :3]


def _masked(alpha: Tensor, cosine: Tensor) -> Tensor:
    """Smith's masking of one direction."""
    tangent2 = (1 - cosine * cosine).clamp(min=0) / (cosine * cosine).clamp(min=1e-12)
    return 2 / (1 + (1 + alpha * alpha * tangent2).sqrt())


class UniformSurface:
    """One material everywhere."""

    def __init__(self, family: ConductorBlend, parameters: list[float]) -> None:
        self._family = family
        self._values = torch.tensor(parameters)

    @property
    def family(self) -> ConductorBlend:
        """What the parameters stand for."""
        return self._family

    def parameters(self, positions: Tensor) -> Tensor:
        """The same for all positions."""
        return self._values.expand(len(positions), -1)
