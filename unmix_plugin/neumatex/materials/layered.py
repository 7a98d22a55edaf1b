"""Analytic layered materials: the truth that the neural decoder learns, and procedural objects are made of.

Notation as in `family`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.dust import LARGEST_COVER
from unmix_plugin.neumatex.materials.layer_stack import (
    LARGEST_COAT_ROUGHNESS,
    LARGEST_DIELECTRIC_F0,
    LARGEST_HAZE,
    LARGEST_SHEEN,
    LayerStack,
)
from unmix_plugin.neumatex.materials.stack_family import StackFamily


class LayeredFamily(StackFamily):
    """Dust over sheen over clear coat over a surface with haze over a base that is diffuse or metal.

    Parameters, each in [0, 1]:

    | index | name | meaning |
    | --- | --- | --- |
    | 0 to 2 | base colour | linear RGB; what a metal reflects, and the diffuse albedo of everything else |
    | 3 | metallicity | 0 dielectric, 1 metal |
    | 4 | roughness | perceptual; the GGX width is about its square |
    | 5 | specular level | `f0` of the dielectric, 0 to 0.08; 0.5 is a refractive index of 1.5 |
    | 6 | coat weight | of a clear coat of index 1.5 |
    | 7 | coat roughness | perceptual, 0 to 0.6 |
    | 8 | sheen weight | 0 to 0.6 |
    | 9 | sheen roughness | 0 hugs the silhouette, 1 is all over |
    | 10 | sheen tint | from white to the hue of the base colour |
    | 11 | haze weight | share of the surface's reflection that is spread, 0 to 0.7 |
    | 12 | haze spread | the haze's roughness is `roughness + (1 - roughness) (0.15 + 0.6 spread)` |
    | 13 | dust | cover at normal incidence, 0 to 0.7 |
    """

    PARAMETERS = (
        "base colour R", "base colour G", "base colour B", "metallicity", "roughness", "specular level", "coat weight",
        "coat roughness", "sheen weight", "sheen roughness", "sheen tint", "haze weight", "haze spread", "dust",
    )  # fmt: skip
    num_parameters = len(PARAMETERS)

    def stack(self, parameters: Float[Tensor, "N P"]) -> LayerStack:
        """The layers that the parameters stand for."""
        base, scalars = parameters.T.contiguous().split([3, parameters.shape[1] - 3])
        metallicity, roughness, level, coat, coat_roughness, *others = scalars.unbind(0)
        sheen, sheen_roughness, tint, haze, spread, dust = others
        hue = base / base.amax(0).clamp_min(1e-3)
        hazy = roughness + (1.0 - roughness) * (0.15 + 0.6 * spread)
        return LayerStack(
            dust_cover=LARGEST_COVER * dust,
            sheen_colour=LARGEST_SHEEN * sheen * (1.0 + tint * (hue - 1.0)),
            sheen_roughness=sheen_roughness,
            coat_weight=coat,
            roughness=torch.stack([LARGEST_COAT_ROUGHNESS * coat_roughness, roughness, hazy]),
            haze_weight=LARGEST_HAZE * haze,
            metallicity=metallicity,
            metal_colour=base,
            dielectric_f0=LARGEST_DIELECTRIC_F0 * level,
        )
