"""Cells of a grid over the unit cube: which one a point lies in, which are near one another."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

_MARGIN = 16


def cells_at(points: Float[Tensor, "*points 3"], shape: Sequence[int]) -> Int[Tensor, "*points 3"]:
    """Cell (x, y, z) of each point in the unit cube; of one outside, the nearest along each axis.

    >>> cells_at(torch.tensor([0.0, 0.5, 1.0]), (4, 4, 4))
    tensor([0, 2, 3])
    """
    sides = torch.tensor(tuple(shape), device=points.device)
    return torch.minimum((points * sides).floor().long().clamp(min=0), sides - 1)


def clearance_of(occupied: Bool[Tensor, "X Y Z"]) -> UInt8[Tensor, "X Y Z"]:
    """How many cells the nearest occupied cell is away at least, along the axis on which it is farthest.

    Returns:
        0 in occupied cells, else 1, 2, 3, 5, 9 or 17, rounded down.

    >>> clearance_of(torch.arange(8).view(8, 1, 1) == 0).flatten()
    tensor([0, 1, 2, 3, 3, 5, 5, 5], dtype=torch.uint8)
    """
    # Empty margins keep rows apart, so that a shift along any axis is one of memory: views are ten times as slow.
    side_y, side_z = occupied.shape[1:]
    padded = torch.nn.functional.pad(occupied.to(torch.uint8), (0, _MARGIN, 0, _MARGIN))
    near, clearance = padded.view(-1), 1 - padded.view(-1)
    more = near.clone()
    for reach in (1, 1, 2, 4, 8):
        for stride in (1, padded.stride(1), padded.stride(0)):
            shift = min(reach * stride, len(near))
            more[shift:] |= near[: len(near) - shift]
            more[: len(near) - shift] |= near[shift:]
            near.copy_(more)
        clearance.add_(near, alpha=-reach).add_(reach)
    return clearance.view(padded.shape)[:, :side_y, :side_z].contiguous()
