"""How surfaces look in the light of a lamp whose place is known: matt, with a gloss where they mirror it.

    s(x, d) = sigmoid(s_0 + ...) (r + (1 - r) V max(0, n . l))          matt (Lambert), r from all around
    t_k(x, d) = V exp(-m_k (1 - (n . h)^2))                             gloss, h halfway between l and the eye

The normal n is learnt from what the light does, with r: a lamp that moves shows normals better than thin densities do.
All places of a material mirror alike around their normals, so that few highlights tell where others will be.

Notation: `S` samples, `G` geometry features; l the direction to the lamp, V the visible part of its light.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

from unmix_plugin.light.networks import bias_free_network

LOBES = (8.0, 32.0, 128.0, 512.0)
"""m_k: the last is half as high where the normal is 2 degrees off."""
_FIRST_NORMAL = 0.1
"""Length of the untrained normal before it gets length 1: gradients of shorter ones would outweigh all others."""


@dataclass(frozen=True)
class Lamplight:
    """What of a lamp's light reaches samples."""

    visible: Float[Tensor, "S"]
    """The part that nothing stands in the way of, in [0, 1]."""
    towards: Float[Tensor, "S 3"]
    """Unit directions to the lamp."""


@dataclass(frozen=True)
class LitSurface:
    """How samples look in a lamp's light."""

    brightness: Float[Tensor, "S 1"]
    """Of a matt surface, in [0, 1]: 1 where the lamp shines on it squarely."""
    lobes: Float[Tensor, "S 4"]
    """How well each of `LOBES` mirrors the lamp to the eye."""


class LampShading(nn.Module):
    """Learnt normals, and how much of the light comes from all around."""

    first_normal: Tensor

    def __init__(self, num_features: int, width: int, upwards: Float[Tensor, "3"]) -> None:
        """
        Args:
            num_features: G.
            width: Of the hidden layer.
            upwards: Unit vector that all normals are near at first.
        """
        super().__init__()
        self.register_buffer("first_normal", _FIRST_NORMAL * upwards, persistent=False)
        self.network = bias_free_network(num_features, width, 4)

    def surface(self, features: Float[Tensor, "S G"]) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 1"]]:
        """Unit normals in model space, and r."""
        raw = self.network(features)
        return normalize(raw[:, :3] + self.first_normal, dim=1), torch.sigmoid(raw[:, 3:])

    def forward(
        self, features: Float[Tensor, "S G"], directions: Float[Tensor, "S 3"], light: Lamplight
    ) -> LitSurface:
        """How samples look along unit directions."""
        normals, around = self.surface(features)
        cosine = bounded_below((normals * light.towards).sum(dim=1, keepdim=True))
        visible = light.visible[:, None]
        halfway = normalize(light.towards - directions, dim=1)
        away = 1 - (normals * halfway).sum(dim=1, keepdim=True).clamp(min=0).square()
        lobes = visible * torch.exp(-away * away.new_tensor(LOBES))
        return LitSurface(around + (1 - around) * visible * cosine, lobes)


def bounded_below(cosine: Float[Tensor, "S 1"]) -> Float[Tensor, "S 1"]:
    """max(0, cosine) in value only: a surface that is wrongly turned away from the lamp can still turn back."""
    return cosine + (cosine.clamp(min=0) - cosine).detach()
