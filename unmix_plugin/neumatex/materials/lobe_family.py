"""What families share whose directions to the light are drawn from a cosine lobe and visible GGX normals."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.lobe_mixture import LobeMixture


class LobeFamily(ABC):
    """Sampling by a mixture of lobes; notation as in `family`."""

    @torch.no_grad()
    def sample(
        self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Directions to the light, drawn from a cosine lobe and visible GGX normals."""
        wo = wo.T.contiguous()
        return self._mixture(parameters, wo).sample(wo, uniforms.T.contiguous()).T.contiguous()

    @torch.no_grad()
    def density(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, " N"]:
        """Probability density of `sample`, 1/sr."""
        wo = wo.T.contiguous()
        return self._mixture(parameters, wo).density(wi.T.contiguous(), wo)

    @abstractmethod
    def _mixture(self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "3 N"]) -> LobeMixture:
        """The lobes of each point, seen along a direction."""
