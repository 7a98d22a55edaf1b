"""Importance sampling shared by the families: a cosine lobe and GGX lobes, each with its share.

Notation as in `microfacet`.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.microfacet import reflection_density, sample_reflections


@dataclass(frozen=True)
class LobeMixture:
    """A density of directions to the light for one `wo` per point."""

    alphas: Float[Tensor, "K N"]
    """Widths of the GGX lobes."""
    shares: Float[Tensor, "K1 N"]
    """Of the cosine lobe, then of each GGX lobe; they sum to 1."""

    @staticmethod
    def of_albedos(
        alphas: Float[Tensor, "K N"], diffuse: Float[Tensor, " N"], specular: Float[Tensor, "K N"]
    ) -> "LobeMixture":
        """Shares in proportion to what each lobe reflects; every lobe keeps a small one, which bounds estimates."""
        albedos = torch.cat([diffuse[None] + 0.05, specular + 0.005])
        return LobeMixture(alphas, albedos / albedos.sum(0))

    def sample(self, wo: Float[Tensor, "3 N"], uniforms: Float[Tensor, "3 N"]) -> Float[Tensor, "3 N"]:
        """Directions to the light; those of GGX lobes can point below the surface."""
        lobe = (uniforms[2] >= self.shares.cumsum(0)).sum(0).clamp_max(len(self.alphas))
        alpha = self.alphas.gather(0, (lobe - 1).clamp_min(0)[None])[0]
        reflected = sample_reflections(alpha, wo, uniforms[:2])
        return torch.where(lobe == 0, cosine_directions(uniforms[:2]), reflected)

    def density(self, wi: Float[Tensor, "3 N"], wo: Float[Tensor, "3 N"]) -> Float[Tensor, " N"]:
        """Of `sample`, 1/sr, on the whole sphere."""
        lobes = (self.shares[1:] * reflection_density(self.alphas, wi, wo)).sum(0)
        return self.shares[0] * (wi[2].clamp_min(0.0) / math.pi) + lobes


def cosine_directions(uniforms: Float[Tensor, "2 N"]) -> Float[Tensor, "3 N"]:
    """Directions above the surface whose density is their cosine over pi."""
    radius, angle = torch.sqrt(uniforms[1]), 2.0 * math.pi * uniforms[0]
    z = torch.sqrt((1.0 - uniforms[1]).clamp_min(0.0))
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), z])
