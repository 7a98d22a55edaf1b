"""Which cells of contracted space may be occupied: those that enough training views see.

What one view alone sees is not held by the others: before each camera lies such a space, and what grows there is fog.
Far away, where a small part of a world fits into a view, two views are enough; near a camera more must agree.

Notation: `R` cells along an edge of the contracted cube, `N` cameras.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.contraction import UnitSpace
from unmix_plugin.engine.geometry.scene_box import SceneBox

SEEN_CELLS = 64
"""Cells along an edge in which visibility is judged; finer grids repeat it."""
SHARE = 0.05
"""Share of the training views that must see a cell, but two of them at least."""
NEAR_SHARE = 0.2
"""The same of cells near a camera."""
NEAR = 0.6
"""What is near, in distances from the cameras to the middle of the box, median over cameras."""
_BLOCK = 1 << 16


def carve_world(cameras: Cameras, box: SceneBox, resolution: int) -> Bool[np.ndarray, "R R R"]:
    """Cells that may be occupied.

    Args:
        cameras: Of the training views.
        box: The scene box, which the world is contracted around.
        resolution: Cells along each edge of the grid.
    """
    cells = min(resolution, SEEN_CELLS)
    unit = (torch.cartesian_prod(*[torch.arange(cells)] * 3) + 0.5) / cells
    points = UnitSpace(box, is_unbounded=True).from_unit(unit)
    seen_by = torch.cat([_count_views(cameras, part) for part in points.split(_BLOCK)])
    positions = cameras.camera_to_world[:, :, 3]
    limit = NEAR * float((positions - box.aabb.mean(dim=0)).norm(dim=-1).median())
    nearest = torch.cat([torch.cdist(part, positions).amin(dim=1) for part in points.split(_BLOCK)])
    fewest = torch.where(nearest < limit, _number(NEAR_SHARE, cameras), _number(SHARE, cameras))
    kept = _with_neighbours((seen_by >= fewest).view(cells, cells, cells))
    index = torch.arange(resolution) * cells // resolution
    return kept[index][:, index][:, :, index].numpy()


def _number(share: float, cameras: Cameras) -> int:
    """Of views: a share of all, but two at least if there are two."""
    return min(max(2, math.ceil(share * len(cameras))), len(cameras))


def _count_views(cameras: Cameras, points: torch.Tensor) -> torch.Tensor:
    count = torch.zeros(len(points), dtype=torch.int64)
    for index in range(len(cameras)):
        pixels, depths = cameras.project(points, index)
        limits = torch.tensor(cameras.size(index), dtype=torch.float32)
        count += ((pixels >= 0.0) & (pixels <= limits)).all(dim=-1) & (depths > 0.0)
    return count


def _with_neighbours(cells: torch.Tensor) -> torch.Tensor:
    """A cell counts by its centre, so those beside one that is seen may be seen in part."""
    grown = torch.nn.functional.max_pool3d(cells.float()[None, None], 3, stride=1, padding=1)
    return grown[0, 0] > 0
