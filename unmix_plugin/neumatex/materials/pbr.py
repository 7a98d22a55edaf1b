"""The metallic-roughness materials of glTF 2.0: five numbers a point.

Notation as in `family`; inside, as in `microfacet`. As published these materials may reflect up to twice the light at
grazing angles, where the diffuse part does not know how much the surface reflects. That is kept: files of this kind
mean just this.
"""

import math

from jaxtyping import Float
from torch import Tensor

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

_DIELECTRIC_F0 = 0.04


class PbrFamily(LobeFamily):
    """Parameters: base colour (0 to 2, linear), roughness (3), metallicity (4).

    Source:
        glTF 2.0 specification, appendix B.
    """

    PARAMETERS = ("base colour R", "base colour G", "base colour B", "roughness", "metallicity")
    num_parameters = len(PARAMETERS)
    num_colours = 3

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N C"]:
        """Reflectance, 1/sr, without the cosine; 0 where a direction is below the surface."""
        base, roughness, metallicity = _columns(parameters)
        wi, wo = wi.T.contiguous(), wo.T.contiguous()
        half = half_vectors(wi, wo)
        f0 = _DIELECTRIC_F0 + metallicity * (base - _DIELECTRIC_F0)
        fresnel = f0 + (1.0 - f0) * schlick(dot(wo, half))
        alpha = alpha_of(roughness)
        lobe = distribution(alpha, half) * visibility(alpha, wi[2], wo[2])
        diffuse = (1.0 - fresnel) * ((1.0 - metallicity) / math.pi) * base
        return ((diffuse + fresnel * lobe) * ((wi[2] > 0) & (wo[2] > 0))).T

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N C"]:
        """Linear base colour; of metals, the colour of what they reflect."""
        return parameters[:, :3]

    def _mixture(self, parameters: Tensor, wo: Tensor) -> LobeMixture:
        base, roughness, metallicity = _columns(parameters)
        f0 = _DIELECTRIC_F0 + metallicity * (base.mean(0) - _DIELECTRIC_F0)
        specular = f0 + (1.0 - f0) * schlick(wo[2])
        diffuse = (1.0 - metallicity) * base.mean(0) * (1.0 - f0)
        return LobeMixture.of_albedos(alpha_of(roughness), diffuse[0], specular)


def _columns(parameters: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Base colour (3 N), roughness (1 N) and metallicity (1 N)."""
    base, roughness, metallicity = parameters.T.contiguous().split([3, 1, 1])
    return base, roughness, metallicity
