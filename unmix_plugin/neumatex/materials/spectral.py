"""Spectral materials: a diffuse base that is a mixture of endmember reflectances, and a grey gloss above it.

Notation as in `family`, with `B` bands for its colours and `K` endmembers. With abundances a, endmembers E and the
albedo A of the gloss for light from one direction,

    f = (1 - A(wi)) (1 - A(wo)) / (1 - mean A) (a E) / pi + gloss(wi, wo)

The gloss is one GGX lobe, the same in all bands. What it reflects does not reach the base, so a white base under it
reflects all light, and no material more than it gets.
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.albedos import ggx_albedo, mean_ggx_albedo
from unmix_plugin.neumatex.materials.lobe_family import LobeFamily
from unmix_plugin.neumatex.materials.lobe_mixture import LobeMixture
from unmix_plugin.neumatex.materials.microfacet import (
    alpha_of,
    distribution,
    dot,
    half_vectors,
    schlick,
    visibility,
)

NUM_GLOSS = 2
"""Parameters of the gloss."""


class SpectralFamily(LobeFamily):
    """Parameters: abundances (0 to K - 1, at least 0, sum 1), roughness (K), specular level (K + 1).

    The gloss reflects the square of the specular level at normal incidence: 0.2 is a common dielectric's 4 %.
    """

    def __init__(self, endmembers: Float[Tensor, "K B"], gains: Float[Tensor, " K"] | None = None) -> None:
        """
        Args:
            endmembers: Reflectances, [0, 1]; kept as they are given, so that their gradients arrive there.
            gains: Factors of the endmembers, whose gradients tell how bright these should be. They are 1 except within
                a step of training, so that `endmembers` are the whole reflectances.
        """
        self.endmembers = endmembers
        self.gains = endmembers.new_ones(len(endmembers)) if gains is None else gains

    @property
    def num_endmembers(self) -> int:
        """K."""
        return self.endmembers.shape[0]

    @property
    def num_parameters(self) -> int:
        """K + 2."""
        return self.num_endmembers + NUM_GLOSS

    @property
    def num_colours(self) -> int:
        """B."""
        return self.endmembers.shape[1]

    @property
    def PARAMETERS(self) -> tuple[str, ...]:  # noqa: N802 - as the other families call it
        """Names of the parameters."""
        shares = tuple(f"abundance {index}" for index in range(self.num_endmembers))
        return (*shares, "roughness", "specular level")

    def abundances(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N K"]:
        """Share of each endmember."""
        return parameters[:, : self.num_endmembers]

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N C"]:
        """Reflectance, 1/sr, without the cosine; 0 where a direction is below the surface."""
        roughness, f0 = self._gloss(parameters)
        wi, wo = wi.T.contiguous(), wo.T.contiguous()
        half = half_vectors(wi, wo)
        alpha = alpha_of(roughness)
        fresnel = f0 + (1.0 - f0) * schlick(dot(wo, half))
        gloss = fresnel * distribution(alpha, half) * visibility(alpha, wi[2], wo[2])
        a, b = mean_ggx_albedo(roughness)
        passed = _passing(roughness, f0, wi[2]) * _passing(roughness, f0, wo[2]) / (1.0 - (f0 * a + b))
        above = (wi[2] > 0) & (wo[2] > 0)
        base = self.base_colour(parameters)
        return (passed * above / math.pi).T * base + (gloss * above).T

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N C"]:
        """Diffuse reflectance of each band, [0, 1]."""
        return self.abundances(parameters) @ (self.gains[:, None] * self.endmembers)

    def _gloss(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Roughness (1 N), and what the gloss reflects at normal incidence (1 N)."""
        roughness, level = parameters[:, self.num_endmembers :].T.contiguous().split([1, 1])
        return roughness, level * level

    def _mixture(self, parameters: Tensor, wo: Tensor) -> LobeMixture:
        roughness, f0 = self._gloss(parameters)
        passed = _passing(roughness, f0, wo[2])
        diffuse = passed[0] * self.base_colour(parameters).mean(dim=1)
        return LobeMixture.of_albedos(alpha_of(roughness), diffuse, 1.0 - passed)


def _passing(
    roughness: Float[Tensor, "1 N"], f0: Float[Tensor, "1 N"], cosine: Float[Tensor, " N"]
) -> Float[Tensor, "1 N"]:
    """Share of light from a direction that the gloss does not reflect."""
    a, b = ggx_albedo(roughness, cosine.clamp_min(0.0))
    return 1.0 - (f0 * a + b)
