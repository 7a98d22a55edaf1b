"""A thin coat of dust: grey-brown, thicker to see along it than through it.

What a direction passes through falls with its cosine mu as `(1 - cover)^(1 / mu)`; the rest is scattered such that a
white dust would lose no light.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.microfacet import SMALLEST_COSINE

LARGEST_COVER = 0.7
DUST_COLOUR = (0.52, 0.46, 0.38)
"""Linear RGB."""


def dust_passed(cover: Float[Tensor, " N"], cosine: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Share of light along a direction that passes the dust.

    >>> dust_passed(torch.tensor([0.5]), torch.tensor([0.5]))
    tensor([0.2500])
    """
    return torch.exp(torch.log1p(-cover) / cosine.clamp_min(SMALLEST_COSINE))


def mean_held(cover: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Share of cosine-weighted light of the whole hemisphere that the dust holds back.

    With tau = -log(1 - cover) it is 1 - 2 E3(tau); the exponential integral is summed at Gauss-Legendre nodes.
    """
    log_passed = torch.log1p(-cover)
    nodes = zip(_NODES, _WEIGHTS, strict=True)
    passed = [2.0 * weight * mu * torch.exp(log_passed * (1.0 / mu)) for mu, weight in nodes]
    return 1.0 - torch.stack(passed).sum(0)


# Six nodes of Gauss and Legendre on [0, 1].
_NODES = (0.03376524, 0.16939531, 0.38069041, 0.61930959, 0.83060469, 0.96623476)
_WEIGHTS = (0.08566225, 0.18038079, 0.23395697, 0.23395697, 0.18038079, 0.08566225)
