"""Materials that are a stack of layers over a diffuse base.

Notation as in `family`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.layer_stack import LayerStack


class StackFamily(ABC):
    """Parameters of a material; the first three are its diffuse colour, linear, and all of them give its layers."""

    num_colours = 3

    @abstractmethod
    def stack(self, parameters: Float[Tensor, "N P"]) -> LayerStack:
        """The layers that the parameters stand for."""

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N C"]:
        """Reflectance, 1/sr, without the cosine: what passes the layers times the base over pi, and what they
        reflect; 0 where a direction is below the surface."""
        passed, specular = self.stack(parameters).reflectance(wi.T.contiguous(), wo.T.contiguous())
        return ((passed / math.pi) * self.diffuse_colour(parameters).T + specular).T

    @torch.no_grad()
    def sample(
        self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Directions to the light, drawn from a cosine lobe and three GGX lobes."""
        wo = wo.T.contiguous()
        mixture = self.stack(parameters).mixture(wo, self.diffuse_colour(parameters).T)
        return mixture.sample(wo, uniforms.T.contiguous()).T.contiguous()

    @torch.no_grad()
    def density(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, " N"]:
        """Probability density of `sample`, 1/sr."""
        wo = wo.T.contiguous()
        mixture = self.stack(parameters).mixture(wo, self.diffuse_colour(parameters).T)
        return mixture.density(wi.T.contiguous(), wo)

    def diffuse_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N C"]:
        """Linear albedo of what is below the layers; a metal has nothing there, and the colour says nothing."""
        return parameters[:, :3]

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N C"]:
        """Linear base colour: what a metal reflects, and the diffuse albedo of everything else."""
        layers = self.stack(parameters)
        return torch.lerp(self.diffuse_colour(parameters), layers.metal_colour.T, layers.metallicity[:, None])
