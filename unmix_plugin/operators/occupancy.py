"""A grid over the scene box of which cells may be occupied, so that rays skip empty space.

Each cell keeps an exponential moving maximum of the densities probed in it. The grid only says what is empty; what is
visible is decided from the field's own densities, since a cell's maximum would hide what lies behind its empty part.

Source: Mueller et al. 2022, appendix C.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from unmix_plugin.operators.grid_cells import cells_at, clearance_of
from unmix_plugin.operators.visibility import VisibleCells

_OPAQUE = 3.0
"""Density from which a cell casts shadows, in that from which it counts as occupied."""

DensityFn = Callable[[Float[Tensor, "S 3"]], Float[Tensor, "S"]]
_NOTHING_MET = -1.0


class OccupancyGrid(nn.Module):
    """Moving maxima of density in the cells of the unit cube and which of them count as occupied."""

    peak_densities: Tensor
    occupied: Tensor
    clearance: Tensor
    """As `clearance_of` says, of the occupied cells."""
    met: Tensor | None
    """Largest density met in each cell since the last update."""
    reachable: Tensor
    reachable_cells: Tensor
    opaque: Tensor | None
    opaque_clearance: Tensor | None
    """As `clearance_of` says, of the cells that cast shadows."""

    def __init__(
        self, reachable: Bool[Tensor, "X Y Z"], casts_shadows: bool = False, records_met: bool = False
    ) -> None:
        """Start with every cell occupied that `reachable` allows; the others always stay empty.

        Args:
            casts_shadows: Whether to keep the cells that are opaque, none at the start.
            records_met: Whether densities that rays meet are noted, so that updates need not probe those cells.
        """
        super().__init__()
        self.visibility = VisibleCells(reachable.shape)
        self.register_buffer("reachable", reachable.clone())
        self.register_buffer("peak_densities", torch.full(reachable.shape, torch.inf))
        self.register_buffer("occupied", reachable.to(torch.uint8))
        opaque = torch.zeros(reachable.shape, dtype=torch.uint8) if casts_shadows else None
        self.register_buffer("opaque", opaque)
        self.register_buffer("opaque_clearance", _clearance(opaque), persistent=False)
        self.register_buffer("met", torch.full(reachable.shape, _NOTHING_MET) if records_met else None)
        self.register_buffer("clearance", clearance_of(reachable), persistent=False)
        self.register_buffer("reachable_cells", _flat_indices(reachable), persistent=False)
        self.register_load_state_dict_post_hook(lambda grid, _: grid._follow())

    @torch.no_grad()
    def update(
        self,
        density_fn: DensityFn,
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
            generator: Source of the points and cells.
            block: Cells along the edge of blocks of which each counts as one cell, as dense as the densest in it.
            fewest_rays: Rays to cast at least before visibility is decided anew.
        """
        cells = self._choose_cells(num_cells, generator)
        sides = torch.tensor(self.occupied.shape, device=cells.device)
        offsets = torch.rand(len(cells), 3, generator=generator).to(cells.device)
        densities = density_fn((self._coordinates(cells) + offsets) / sides)
        self._take_in(cells, densities, decay, block)
        peaks = self.peak_densities.view(-1)
        reachable_peaks = peaks[self.reachable_cells]
        is_known = torch.isfinite(reachable_peaks)
        known_peaks = reachable_peaks if bool(is_known.all()) else reachable_peaks[is_known]
        limit = min(threshold, float(known_peaks.mean())) if len(known_peaks) else threshold
        self.visibility.update(fewest_rays)
        is_visible = self.visibility.visible.view(-1)[self.reachable_cells]
        self.occupied.view(-1)[self.reachable_cells] = ((reachable_peaks > limit) & is_visible).byte()
        if self.opaque is not None and self.opaque_clearance is not None:
            is_opaque = is_known & is_visible & (reachable_peaks > _OPAQUE * limit)
            self.opaque.view(-1)[self.reachable_cells] = is_opaque.byte()
            self.opaque_clearance.copy_(clearance_of(self.opaque != 0))
        self.clearance.copy_(clearance_of(self.occupied != 0))

    @torch.no_grad()
    def empty_beyond(self, reachable: Bool[Tensor, "X Y Z"]) -> None:
        """From now on keep those cells empty too that `reachable` leaves out."""
        self.reachable &= reachable
        self.occupied *= self.reachable
        if self.opaque is not None:
            self.opaque *= self.reachable
        self._follow()

    @torch.no_grad()
    def record_met(self, points: Float[Tensor, "S 3"], densities: Float[Tensor, "S"]) -> None:
        """Note the densities of points in the unit cube, as far as this grid records what rays meet."""
        if self.met is not None:
            _, side_y, side_z = self.met.shape
            x, y, z = cells_at(points, self.met.shape).unbind(-1)
            self.met.view(-1).scatter_reduce_(0, (x * side_y + y) * side_z + z, densities, "amax")

    def _take_in(
        self, cells: Int[Tensor, "N"], densities: Float[Tensor, "N"], decay: float, block: int
    ) -> None:
        """Let what was probed and what rays met change the peaks, each cell's once, and clear what was met."""
        peaks = self.peak_densities
        found = torch.full_like(peaks, _NOTHING_MET) if self.met is None else self.met.clone()
        found.view(-1)[cells] = torch.maximum(found.view(-1)[cells], densities)
        if block > 1:
            found = _block_maxima(found, block)
        peaks.copy_(torch.where(found > _NOTHING_MET, torch.maximum(_decayed(peaks, decay), found), peaks))
        if self.met is not None:
            self.met.fill_(_NOTHING_MET)

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
        """Find what follows from cells that were loaded or emptied: searching the whole grid takes longer than an
        update."""
        self.reachable_cells = _flat_indices(self.reachable)
        self.clearance = clearance_of(self.occupied != 0)
        self.opaque_clearance = _clearance(self.opaque)

    def _coordinates(self, cells: Int[Tensor, "N"]) -> Float[Tensor, "N 3"]:
        _, side_y, side_z = self.occupied.shape
        x, rest = cells // (side_y * side_z), cells % (side_y * side_z)
        return torch.stack([x, rest // side_z, rest % side_z], dim=-1).float()


def _decayed(peaks: Float[Tensor, "*cells"], decay: float) -> Float[Tensor, "*cells"]:
    """Remembered maxima of cells that are looked at once more; 0 where nothing was known."""
    return torch.where(torch.isinf(peaks), 0.0, peaks * decay)


def _block_maxima(values: Float[Tensor, "X Y Z"], block: int) -> Float[Tensor, "X Y Z"]:
    """The largest value in the block that each cell belongs to."""
    found = torch.nn.functional.max_pool3d(values[None, None], block, ceil_mode=True)[0, 0]
    for axis, side in enumerate(values.shape):
        found = found.repeat_interleave(block, dim=axis).narrow(axis, 0, side)
    return found


def _flat_indices(reachable: Bool[Tensor, "X Y Z"]) -> Int[Tensor, "N"]:
    return reachable.view(-1).nonzero()[:, 0]


def _clearance(cells: UInt8[Tensor, "X Y Z"] | None) -> UInt8[Tensor, "X Y Z"] | None:
    return None if cells is None else clearance_of(cells != 0)
