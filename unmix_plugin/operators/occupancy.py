"""A grid over the scene box of which cells may be occupied, so that rays skip empty space.

Each cell keeps an exponential moving maximum of the densities probed in it. The grid only says what is empty; what
light reaches is decided from the field's own densities, since a cell's maximum would hide what lies behind its empty
part.

Behind every surface lies space that no training ray reaches. What a field says there was never compared with a picture:
from another side it is a grey floater, and it costs time. What one view alone sees isn't held by the others, and grows
into shapes that fit a single picture. So rays note where they end, and once enough of them were cast, cells stay
visible if two views saw them or a neighbour of theirs. A surface that moves by a cell takes the open cells with it.

Source: Mueller et al. 2022, appendix C (occupancy); the visibility masks of Warburg et al. 2023, Nerfbusters, which
evaluate a field only where training views saw it; here they are kept while training.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

_MARGIN = 16


def cells_at(points: Float[Tensor, "*points 3"], shape: Sequence[int]) -> Int[Tensor, "*points 3"]:
    """Cell (x, y, z) of each point in the unit cube; of one outside, the nearest along each axis.

    >>> cells_at(torch.tensor([0.0, 0.5, 1.0]), (4, 4, 4))
    tensor([0, 2, 3])
    """
    sides = torch.tensor(tuple(shape), device=points.device)
    return torch.minimum((points * sides).floor().long().clamp(min=0), sides - 1)


def flat_cells_at(points: Float[Tensor, "S 3"], shape: Sequence[int]) -> Int[Tensor, "S"]:
    """The same by the numbers of the cells in memory."""
    x, y, z = cells_at(points, shape).unbind(-1)
    return (x * shape[1] + y) * shape[2] + z


def skip_distances(occupied: Bool[Tensor, "X Y Z"]) -> UInt8[Tensor, "X Y Z"]:
    """How many cells the nearest occupied cell is away at least, along the axis on which it is farthest.

    Returns:
        0 in occupied cells, else 1, 2, 3, 5, 9 or 17, rounded down.

    >>> skip_distances(torch.arange(8).view(8, 1, 1) == 0).flatten()
    tensor([0, 1, 2, 3, 3, 5, 5, 5], dtype=torch.uint8)
    """
    # Empty margins keep rows apart, so that a shift along any axis is one of memory: views are ten times as slow.
    side_y, side_z = occupied.shape[1:]
    padded = torch.nn.functional.pad(occupied.to(torch.uint8), (0, _MARGIN, 0, _MARGIN))
    near, skips = padded.view(-1), 1 - padded.view(-1)
    more = near.clone()
    for reach in (1, 1, 2, 4, 8):
        for stride in (1, padded.stride(1), padded.stride(0)):
            shift = min(reach * stride, len(near))
            more[shift:] |= near[: len(near) - shift]
            more[: len(near) - shift] |= near[shift:]
            near.copy_(more)
        skips.add_(near, alpha=-reach).add_(reach)
    return skips.view(padded.shape)[:, :side_y, :side_z].contiguous()


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
        """Note which views see the cells of points in the unit cube, of which `seen` marks those that send enough of
        their ray's light to the camera; of so many rays in all processes."""
        cells = flat_cells_at(points, self.visible.shape)
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


_OPAQUE = 3.0
"""Density from which a cell casts shadows, in that from which it counts as occupied."""

_DensityFn = Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]
_NOT_OBSERVED = -1.0


class OccupancyGrid(nn.Module):
    """Moving maxima of density in the cells of the unit cube and which of them count as occupied."""

    peak_densities: Tensor
    occupied: Tensor
    skips: Tensor
    """As `skip_distances` says, of the occupied cells."""
    observed: Tensor | None
    """Largest density that rays met in each cell since the last update."""
    reachable: Tensor
    reachable_cells: Tensor
    opaque: Tensor | None
    opaque_skips: Tensor | None
    """As `skip_distances` says, of the cells that cast shadows."""

    def __init__(
        self, reachable: Bool[Tensor, "X Y Z"], casts_shadows: bool = False, records_observed: bool = False
    ) -> None:
        """Start with every cell occupied that `reachable` allows; the others always stay empty. Keep which cells are
        opaque, none at the start, where some cast shadows; and what densities rays meet, so that updates need not probe
        those cells, where that is recorded."""
        super().__init__()
        self.visibility = VisibleCells(reachable.shape)
        self.register_buffer("reachable", reachable.clone())
        self.register_buffer("peak_densities", torch.full(reachable.shape, torch.inf))
        self.register_buffer("occupied", reachable.to(torch.uint8))
        opaque = torch.zeros(reachable.shape, dtype=torch.uint8) if casts_shadows else None
        self.register_buffer("opaque", opaque)
        self.register_buffer(
            "observed", torch.full(reachable.shape, _NOT_OBSERVED) if records_observed else None
        )
        for name in ("reachable_cells", "skips", "opaque_skips"):
            self.register_buffer(name, None, persistent=False)
        self._follow()
        self.register_load_state_dict_post_hook(lambda grid, _: grid._follow())

    @torch.no_grad()
    def update(
        self,
        density_fn: _DensityFn,
        threshold: float,
        decay: float,
        num_cells: int | None,
        generator: torch.Generator,
        block: int = 1,
        fewest_rays: int = 0,
    ) -> None:
        """Probe one random point in each of some cells and decide anew what is occupied: dense and visible.

        Args:
            density_fn: Points in the unit cube to densities.
            threshold: Density from which a cell counts as occupied; never above the mean over reachable cells.
            decay: Factor on a probed cell's old maximum.
            num_cells: Cells to probe: half drawn from the occupied ones, half from all reachable ones; None for all.
            block: Cells along the edge of blocks of which each counts as one cell, as dense as the densest in it.
            fewest_rays: Rays to cast at least before visibility is decided anew.
        """
        cells = self._choose_cells(num_cells, generator)
        sides = torch.tensor(self.occupied.shape, device=cells.device)
        _, num_y, num_z = self.occupied.shape
        # torch.unravel_index imports sympy: half a second in each training.
        corners = torch.stack(
            [cells // (num_y * num_z), cells // num_z % num_y, cells % num_z], dim=-1
        ).float()
        offsets = torch.rand(len(cells), 3, generator=generator).to(cells.device)
        densities = density_fn((corners + offsets) / sides)
        self._update_peaks(cells, densities, decay, block)
        peaks = self.peak_densities.view(-1)
        reachable_peaks = peaks[self.reachable_cells]
        is_known = torch.isfinite(reachable_peaks)
        known_peaks = reachable_peaks if bool(is_known.all()) else reachable_peaks[is_known]
        limit = min(threshold, float(known_peaks.mean())) if len(known_peaks) else threshold
        self.visibility.update(fewest_rays)
        is_visible = self.visibility.visible.view(-1)[self.reachable_cells]
        self.occupied.view(-1)[self.reachable_cells] = ((reachable_peaks > limit) & is_visible).byte()
        if self.opaque is not None and self.opaque_skips is not None:
            is_opaque = is_known & is_visible & (reachable_peaks > _OPAQUE * limit)
            self.opaque.view(-1)[self.reachable_cells] = is_opaque.byte()
            self.opaque_skips.copy_(skip_distances(self.opaque != 0))
        self.skips.copy_(skip_distances(self.occupied != 0))

    @torch.no_grad()
    def empty_beyond(self, reachable: Bool[Tensor, "X Y Z"]) -> None:
        """From now on keep those cells empty too that `reachable` leaves out."""
        self.reachable &= reachable
        self.occupied *= self.reachable
        if self.opaque is not None:
            self.opaque *= self.reachable
        self._follow()

    @torch.no_grad()
    def record_observed(self, points: Float[Tensor, "S 3"], densities: Float[Tensor, "S"]) -> None:
        """Note the densities of points in the unit cube, as far as this grid records what rays meet."""
        if self.observed is not None:
            cells = flat_cells_at(points, self.observed.shape)
            self.observed.view(-1).scatter_reduce_(0, cells, densities, "amax")

    def _update_peaks(
        self, cells: Int[Tensor, "N"], densities: Float[Tensor, "N"], decay: float, block: int
    ) -> None:
        """Let what was probed and what rays met change the peaks, each cell's once, and clear what was met."""
        peaks = self.peak_densities
        found = torch.full_like(peaks, _NOT_OBSERVED) if self.observed is None else self.observed.clone()
        found.view(-1)[cells] = torch.maximum(found.view(-1)[cells], densities)
        if block > 1:
            found = _block_maxima(found, block)
        remembered = torch.where(torch.isinf(peaks), 0.0, peaks * decay)  # infinite where nothing was known
        peaks.copy_(torch.where(found > _NOT_OBSERVED, torch.maximum(remembered, found), peaks))
        if self.observed is not None:
            self.observed.fill_(_NOT_OBSERVED)

    def _choose_cells(self, num_cells: int | None, generator: torch.Generator) -> Int[Tensor, "N"]:
        reachable = self.reachable_cells
        if num_cells is None or num_cells >= len(reachable):
            return reachable
        occupied = reachable[self.occupied.view(-1)[reachable] != 0]
        chosen = [
            pool[torch.randint(len(pool), (num_cells // 2,), generator=generator).to(pool.device)]
            for pool in (reachable, occupied)
            if len(pool)
        ]
        return torch.cat(chosen).unique()

    def _follow(self) -> None:
        """Find what follows from cells that are new, loaded or emptied: searching the whole grid takes longer than an
        update."""
        self.reachable_cells = self.reachable.view(-1).nonzero()[:, 0]
        self.skips = skip_distances(self.occupied != 0)
        self.opaque_skips = None if self.opaque is None else skip_distances(self.opaque != 0)


def _block_maxima(values: Float[Tensor, "X Y Z"], block: int) -> Float[Tensor, "X Y Z"]:
    """The largest value in the block that each cell belongs to."""
    found = torch.nn.functional.max_pool3d(values[None, None], block, ceil_mode=True)[0, 0]
    for axis, side in enumerate(values.shape):
        found = found.repeat_interleave(block, dim=axis).narrow(axis, 0, side)
    return found
