"""Which cells training rays have recently ended in: elsewhere nothing was learnt, and nothing is shown.

Behind every surface lies space that no training ray reaches. What a field says there was never compared with a picture:
from another side it is a grey floater, and it costs time. What one view alone sees isn't held by the others, and grows
into shapes that fit a single picture.

So rays note where they end, and once enough of them were cast, cells stay visible if two views saw them or a neighbour
of theirs. A surface that moves by a cell takes the open cells with it.

Source: the visibility masks of Warburg et al. 2023, Nerfbusters, which evaluate a field only where training views saw
it; here they are kept while training.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from unmix_plugin.operators.grid_cells import cells_at

_RAYS_A_CELL = 16
"""Rays to cast for each cell of a face of the grid before visibility is decided anew."""
_NO_VIEW = 255
"""Views are told apart by their number modulo this, which takes one byte a cell and leaves this number for none."""


class VisibleCells(nn.Module):
    """Cells that two training views have seen, by the rays cast since the last update."""

    visible: Bool[Tensor, "X Y Z"]
    lowest_view: UInt8[Tensor, "X Y Z"]
    highest_view: UInt8[Tensor, "X Y Z"]
    num_rays: Int[Tensor, ""]

    def __init__(self, shape: Sequence[int]) -> None:
        """Start with every cell of a grid of this shape visible."""
        super().__init__()
        self.register_buffer("visible", torch.ones(*shape, dtype=torch.bool))
        self.register_buffer("lowest_view", torch.full(tuple(shape), _NO_VIEW, dtype=torch.uint8))
        self.register_buffer("highest_view", torch.zeros(*shape, dtype=torch.uint8))
        self.register_buffer("num_rays", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def record(
        self, points: Float[Tensor, "S 3"], views: Int[Tensor, "S"], seen: Bool[Tensor, "S"], num_rays: int
    ) -> None:
        """Note which views see which cells.

        Args:
            points: Samples in the unit cube.
            views: Number of the view of each.
            seen: Samples that send enough of their ray's light to the camera.
            num_rays: Rays that the samples are of; of all processes, where several train together.
        """
        _, side_y, side_z = self.visible.shape
        x, y, z = cells_at(points, self.visible.shape).unbind(-1)
        cells = (x * side_y + y) * side_z + z
        ids = (views % _NO_VIEW).to(torch.uint8)
        # Unseen samples take part with a number that changes nothing: to choose would be to wait for the device.
        self.lowest_view.view(-1).scatter_reduce_(0, cells, ids.masked_fill(~seen, _NO_VIEW), "amin")
        self.highest_view.view(-1).scatter_reduce_(0, cells, ids.masked_fill(~seen, 0), "amax")
        self.num_rays += num_rays

    @torch.no_grad()
    def update(self, fewest_rays: int = 0) -> None:
        """Keep only what two views saw, if `fewest_rays` and enough for each cell were cast, and start over.

        Where two views saw no cell, what one saw is kept; where none saw any, as in thin semi-transparent density, all
        that was visible.
        """
        sides = sorted(self.visible.shape)
        if int(self.num_rays) < max(_RAYS_A_CELL * sides[1] * sides[2], fewest_rays):
            return
        seen_by_two = self.lowest_view < self.highest_view
        seen = seen_by_two if bool(seen_by_two.any()) else self.lowest_view <= self.highest_view
        if bool(seen.any()):
            self.visible.copy_(_with_neighbours(seen))
        self.lowest_view.fill_(_NO_VIEW)
        self.highest_view.zero_()
        self.num_rays.zero_()


def _with_neighbours(cells: Bool[Tensor, "X Y Z"]) -> Bool[Tensor, "X Y Z"]:
    """And the cells that share a face, an edge or a corner with one of them."""
    for axis in range(3):
        grown, count = cells.clone(), cells.shape[axis] - 1
        for here, there in ((1, 0), (0, 1)):
            grown.narrow(axis, here, count).logical_or_(cells.narrow(axis, there, count))
        cells = grown
    return cells
