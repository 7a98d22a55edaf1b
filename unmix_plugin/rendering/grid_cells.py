"""Which cell of a grid over the unit cube a point lies in."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor


def cells_at(points: Float[Tensor, "*points 3"], shape: Sequence[int]) -> Int[Tensor, "*points 3"]:
    """Cell (x, y, z) of each point in the unit cube; of one outside, the nearest along each axis.

    >>> cells_at(torch.tensor([0.0, 0.5, 1.0]), (4, 4, 4))
    tensor([0, 2, 3])
    """
    sides = torch.tensor(tuple(shape), device=points.device)
    return torch.minimum((points * sides).floor().long().clamp(min=0), sides - 1)
