"""Sheen of cloth: the distribution called Charlie.

Notation as in `microfacet`.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.microfacet import SMALLEST_COSINE

_SMALLEST_WIDTH = 0.22
"""Narrower ones would reflect more than all light near the horizon."""


def sheen_reflection(
    roughness: Float[Tensor, " N"],
    half: Float[Tensor, "3 N"],
    n_i: Float[Tensor, " N"],
    n_o: Float[Tensor, " N"],
) -> Float[Tensor, " N"]:
    """White sheen, 1/sr, at a half vector; both directions above the surface.

    Source:
        Estevez and Kulla 2017, Production friendly microfacet sheen BRDF; visibility of Ashikhmin and Premoze.
    """
    exponent = 1.0 / (_SMALLEST_WIDTH + (1.0 - _SMALLEST_WIDTH) * roughness)
    log_sine2 = torch.log((half[0] * half[0] + half[1] * half[1]).clamp_min(1e-12))
    density = (2.0 + exponent) / (2.0 * math.pi) * torch.exp(exponent * (0.5 * log_sine2))
    n_i, n_o = n_i.clamp_min(SMALLEST_COSINE), n_o.clamp_min(SMALLEST_COSINE)
    return density / (4.0 * (n_i + n_o - n_i * n_o))
