"""Keeps the occupancy grid up to date while training: which cells are probed, and which count as occupied."""

from __future__ import annotations

import math

import torch
from jaxtyping import Int
from torch import Tensor

from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.processes import Processes
from unmix_plugin.field import CoefficientField
from unmix_plugin.operators.occupancy import OccupancyGrid
from unmix_plugin.rendering.renderer import RenderedRays, VolumeRenderer

_GRID_INTERVAL = 16
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
"""Of the pixels of the training views, that must be cast before it is decided anew what is visible. In large
pictures a cell has many pixels: fewer rays would by chance miss what few views see, and it would be left out for good.
"""

_SHRINKING = (0.05, 0.3)
"""Parts of the training without alpha between which haze shrinks: rays must first have found about where they end, and
what is shrunk too early stands in the wrong place."""

_LOST = 0.8
"""Opacity of a ray below which it lost what it ended on."""
_MOST_LOST = 64
"""Such rays of a batch that are followed."""


def is_due(step: int) -> bool:
    """Whether the grid is updated before this training step."""
    return step % _GRID_INTERVAL == 0


def update_grid(
    grid: OccupancyGrid,
    field: CoefficientField,
    renderer: VolumeRenderer,
    processes: Processes,
    generator: torch.Generator | None,
    progress: float,
    num_pixels: int = 0,
) -> None:
    """Probe the field in some cells, the same in each process, and decide anew what is occupied.

    Args:
        grid: What is updated in place.
        field: Whose densities are probed.
        renderer: With the distance of samples of the present training step.
        processes: That train together; they share which cells their rays saw.
        generator: Source of the cells.
        progress: Part of the training that is over.
        num_pixels: Of the training views; 0 if it is not known.
    """
    device = torch.device("cpu") if generator is None else generator.device
    drawn = torch.randint(2**62, (1,), generator=generator, device=device)
    seed = int(processes.of_first(drawn))
    share_sights(grid, processes)
    space = renderer.space
    begins_coarsely = renderer.is_unbounded and progress < _FIRST_CELLS_UNTIL
    grid.update(
        lambda points: field.get_density(space.from_unit(points))[0],
        threshold=occupied_density(renderer, max(grid.occupied.shape)),
        decay=_GRID_DECAY,
        num_cells=_PROBED_CELLS,
        generator=torch.Generator().manual_seed(seed),
        block=max(len(grid.occupied) // _FIRST_CELLS, 1) if begins_coarsely else 1,
        fewest_rays=int(_SHARE_OF_PIXELS * num_pixels),
    )


def occupied_density(renderer: VolumeRenderer, num_cells: int) -> float:
    """Density from which a cell counts as occupied.

    Args:
        renderer: With the distance of samples.
        num_cells: Along an edge of the grid.

    Returns:
        Optical depth per model unit.
    """
    by_sample = -math.log1p(-_OCCUPIED_OPACITY) / renderer.step
    across = -math.log1p(-_OPACITY_ACROSS) / (float(renderer.space.shortest_edge) / num_cells)
    return min(by_sample, across)


def share_sights(grid: OccupancyGrid, processes: Processes) -> None:
    """Share which cells the rays of all processes saw, and what they met; twice is as good as once."""
    visibility = grid.visibility
    processes.smallest(visibility.lowest_view)
    processes.largest(visibility.highest_view)
    processes.largest(visibility.num_rays)
    if grid.observed is not None:
        processes.largest(grid.observed)


def record_seen(
    grid: OccupancyGrid,
    rendered: RenderedRays,
    views: Int[Tensor, "N"],
    visible_weight: float,
    processes: Processes,
    shrunk: float | None = None,
) -> None:
    """Note which cells the rays of a batch saw, each of a view; nothing where all cells stay visible.

    Args:
        grid: That notes it.
        rendered: The batch.
        views: Of its rays.
        visible_weight: Share of its ray's light from which a sample counts as seen; 1: all stay visible.
        processes: That train together.
        shrunk: None, or how far haze is to shrink to the surfaces in it, as `shrinking` says. Then the share is one of
            the weight of the heaviest sample of the ray, so that no ray loses what it ends on.
    """
    if visible_weight >= 1 or shrunk == 0:
        return
    rays, weights = rendered.ray_indices, rendered.weights.detach()
    least: Tensor | float = visible_weight
    if shrunk is not None:
        heaviest = weights.new_zeros(len(views)).scatter_reduce_(0, rays, weights, "amax")
        least = visible_weight * shrunk * heaviest.index_select(0, rays)
    own = views.index_select(0, rays)
    grid.visibility.record(rendered.positions, own, weights > least, len(views) * processes.count)


def reopen_lost(grid: OccupancyGrid, rendered: RenderedRays, rays: RayBundle, box: SceneBox) -> None:
    """Let cells on rays that lost what they ended on stay visible, so that they find it again.

    Args:
        grid: Whose cells they are.
        rendered: Rays of a bounded scene without alpha, all of which end on something.
        rays: The same rays.
        box: Of the grid.
    """
    lost = (rendered.coefficients.accumulation.detach() < _LOST).nonzero()[:_MOST_LOST, 0]
    origins, directions = rays.origins.detach()[lost], rays.directions.detach()[lost]
    t_near, t_far = box.intersect(origins, directions)
    count = 2 * max(grid.occupied.shape)
    along = (torch.arange(count, device=lost.device) + 0.5) / count
    t = t_near[:, None] + along * (t_far - t_near).clamp(min=0.0)[:, None]
    points = box.normalise(origins[:, None] + t[..., None] * directions[:, None]).flatten(0, 1)
    own = rays.camera_indices[lost].repeat_interleave(count)
    grid.visibility.record(points, own, torch.ones_like(own, dtype=torch.bool), 0)


def shrinking(progress: float) -> float:
    """How far haze is to shrink when that part of the training is over: 0 at first, 1 in the end."""
    start, end = _SHRINKING
    return min(max((progress - start) / (end - start), 0.0), 1.0)
