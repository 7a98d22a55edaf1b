"""Keeps the occupancy grid up to date while training: which cells are probed, and which count as occupied."""

from __future__ import annotations

import math

import torch

from unmix_plugin.engine.processes import Processes
from unmix_plugin.field import CoefficientField
from unmix_plugin.operators.occupancy import OccupancyGrid
from unmix_plugin.rendering.renderer import VolumeRenderer

GRID_INTERVAL = 16
"""Steps between updates of the occupancy grid."""
_PROBED_CELLS = 32_768
"""Cells of the grid that an update probes."""
_GRID_DECAY = 0.5
"""Factor on the remembered density of a probed cell: lower forgets emptied space sooner."""
_OCCUPIED_OPACITY = 0.03
"""Opacity of one sample's interval from which a cell counts as occupied."""
_OPACITY_ACROSS = 0.08
"""The same of a cell that is several samples wide even the short way: without it soft edges would end in steps as large
as cells. Cells of a flat box are thin, and rays cross them the short way."""

_FIRST_CELLS = 64
"""Along an edge of the grid of a world without end, in the first part of the training: smaller cells are emptied before
surfaces are found."""
_FIRST_CELLS_UNTIL = 0.5
"""That part."""

_SHARE_OF_PIXELS = 0.07
"""Of the pixels of the training views, that must be cast before it is decided anew what is visible. In large pictures
a cell has many pixels: fewer rays would by chance miss what few views see, and it would be left out for good."""


def update_grid(
    grid: OccupancyGrid,
    field: CoefficientField,
    renderer: VolumeRenderer,
    processes: Processes,
    generator: torch.Generator | None,
    *,
    progress: float,
    num_pixels: int = 0,
) -> None:
    """Probe the field in some cells, the same in each process, and decide anew what is occupied. The renderer has the
    distance of samples of the present training step; the training views have so many pixels, 0 if that is not known."""
    device = "cpu" if generator is None else generator.device
    drawn = processes.of_first(torch.randint(2**62, (1,), generator=generator, device=device))
    # Which cells the rays of all processes saw, and what they met; sharing it twice is as good as once.
    visibility = grid.visibility
    processes.reduce(visibility.lowest_view, "min")
    for values in (visibility.highest_view, visibility.num_rays, grid.observed):
        if values is not None:
            processes.reduce(values, "max")
    space = renderer.space
    begins_coarsely = renderer.space.is_unbounded and progress < _FIRST_CELLS_UNTIL
    grid.update(
        lambda points: field.get_density(space.from_unit(points))[0],
        threshold=occupied_density(renderer, max(grid.occupied.shape)),
        decay=_GRID_DECAY,
        num_cells=_PROBED_CELLS,
        generator=torch.Generator().manual_seed(int(drawn)),
        block=max(len(grid.occupied) // _FIRST_CELLS, 1) if begins_coarsely else 1,
        fewest_rays=int(_SHARE_OF_PIXELS * num_pixels),
    )


def occupied_density(renderer: VolumeRenderer, num_cells: int) -> float:
    """Density per model unit from which a cell counts as occupied, of which so many lie along an edge of the grid."""
    by_sample = -math.log1p(-_OCCUPIED_OPACITY) / renderer.step
    across = -math.log1p(-_OPACITY_ACROSS) / (float(renderer.space.shortest_edge) / num_cells)
    return min(by_sample, across)
