"""Sheen of cloth: the distribution called Charlie.

Notation as in `microfacet`.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.microfacet import SMALLEST_COSINE, half_vectors

_SMALLEST_WIDTH = 0.22
"""Narrower ones would reflect more than all light near the horizon."""


def sheen_reflection(
    roughness: Float[Tensor, " N"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
) -> Float[Tensor, " N"]:
    """White sheen, 1/sr; both directions above the surface.

    Source:
        Estevez and Kulla 2017, Production friendly microfacet sheen BRDF; visibility of Ashikhmin and Premoze.
    """
    exponent = 1.0 / (_SMALLEST_WIDTH + (1.0 - _SMALLEST_WIDTH) * roughness)
    half = half_vectors(wi, wo)
    sine = torch.sqrt((half[:, 0].square() + half[:, 1].square()).clamp_min(1e-12))
    density = (2.0 + exponent) * sine.pow(exponent) / (2.0 * math.pi)
    n_i, n_o = wi[:, 2].clamp_min(SMALLEST_COSINE), wo[:, 2].clamp_min(SMALLEST_COSINE)
    return density / (4.0 * (n_i + n_o - n_i * n_o))
