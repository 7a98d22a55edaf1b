"""Drawing indices of a discrete distribution in constant time.

Notation: `n` items.

Source: Walker 1977, An Efficient Method for Generating Discrete Random Variables with General Distributions; built by
Vose's sweep in closed form, so that it takes no loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class AliasTable:
    """n bins of equal probability, each shared by at most two items."""

    keep: Float[Tensor, " n"]
    """Part of a bin that belongs to the item of its index, float64."""
    aliases: Int[Tensor, " n"]
    """The item that has the rest of the bin."""

    def draw(self, uniforms: Float[Tensor, " N"]) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
        """Items, and a new uniform number of each: where in its part of the bin the old one fell.

        Args:
            uniforms: In [0, 1); of float32 ones the new numbers have few digits if the table is long.
        """
        n = len(self.keep)
        scaled = uniforms.double() * n
        bins = scaled.long().clamp(max=n - 1)
        inside, keep = scaled - bins, self.keep[bins]
        own = inside < keep
        rest = torch.where(
            own, inside / keep.clamp(min=1e-300), (inside - keep) / (1 - keep).clamp(min=1e-300)
        )
        return torch.where(own, bins, self.aliases[bins]), rest.clamp(0.0, 1.0 - 1e-12)


def alias_table(weights: Float[Tensor, " n"]) -> AliasTable:
    """The table of items drawn in proportion to weights.

    Args:
        weights: At least 0, not all of them 0.
    """
    shares = weights.double() * (len(weights) / weights.double().sum())
    light, heavy = (shares < 1).nonzero()[:, 0], (shares >= 1).nonzero()[:, 0]
    keep, aliases = torch.ones_like(shares), torch.arange(len(shares), device=shares.device)
    if not len(heavy):  # equal weights that rounding took below 1
        return AliasTable(keep, aliases)
    # Heavy items give what they have above 1 to the gaps of light ones, in order; the last part of a heavy item that
    # a gap overdraws becomes a gap itself, which the next heavy item fills.
    gaps, gifts = (1 - shares[light]).cumsum(0), (shares[heavy] - 1).cumsum(0)
    givers = torch.searchsorted(gifts, gaps - (1 - shares[light]), right=True).clamp(max=len(heavy) - 1)
    keep[light], aliases[light] = shares[light], heavy[givers]
    if len(light):
        closing = torch.searchsorted(gaps, gifts)
        overdrawn = closing < len(light)
        overdrawn[-1] = False  # what is left over at the last one is rounding
        left = (1 + gifts - gaps[closing.clamp(max=len(light) - 1)]).clamp(0.0, 1.0)
        keep[heavy] = torch.where(overdrawn, left, 1.0)
        aliases[heavy] = torch.where(overdrawn, heavy.roll(-1), heavy)
    return AliasTable(keep, aliases)
