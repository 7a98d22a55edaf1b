"""Which cells of contracted space are empty, since several views see what is behind them.

A view looks through a cell if it lies clearly before all known distances of the pixels around it. Known distances may
be wrong in places, so three views must look through a cell, and few may see their surface in it.

Notation: `C` cells along an edge, `P` = C^3 cells, `h x w` pixels of a view with known distances.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.contraction import UnitSpace
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.scenes.geometry.swept_depths import SweptDepths

WITNESSES = 3
"""Views that must look through a cell."""
MOST_CONTRADICTION = 0.15
"""Views that may see a surface in it, over those that look through it."""
MARGIN = 1.5
"""Between a cell's centre and a surface behind it, in edges of the cell."""


def seen_through(depths: SweptDepths, cameras: Cameras, box: SceneBox, cells: int) -> Bool[Tensor, "C C C"]:
    """Cells of the contracted world that are empty.

    Args:
        depths: Of views of `cameras`.
        cameras: Of the training views.
        box: That the world is contracted around.
        cells: Along each edge.
    """
    space = UnitSpace(box, is_unbounded=True)
    unit = (torch.cartesian_prod(*[torch.arange(cells)] * 3) + 0.5) / cells
    points = space.from_unit(unit)
    radii = space.centred(points).abs().amax(dim=-1).clamp(min=1.0)
    margins = MARGIN * 4.0 / cells * float(space.half_edge) * radii.square()
    through, surfaces = torch.zeros(2, len(points))
    for view, distances in zip(depths.views, depths.distances, strict=True):
        nearest, own, away = _looked_up(cameras, view, points, distances, depths.stride)
        through += torch.isfinite(own) & (away + margins < nearest)
        surfaces += (away - own).abs() <= margins
    is_empty = (through >= WITNESSES) & (surfaces <= MOST_CONTRADICTION * through)
    return is_empty.view(cells, cells, cells)


def _looked_up(
    cameras: Cameras, view: int, points: Float[Tensor, "P 3"], distances: Float[Tensor, "h w"], stride: int
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"], Float[Tensor, " P"]]:
    """Of the pixel that a point falls on: the least distance of those around it, its own, and the point's."""
    pixels, depths = cameras.project(points, view)
    limits = torch.tensor([cameras.width, cameras.height])
    is_seen = (depths > 0.0) & ((pixels >= 0.0) & (pixels < limits)).all(dim=-1)
    least = -torch.nn.functional.max_pool2d(-distances[None], 3, stride=1, padding=1)[0]
    columns, rows = (pixels / stride).nan_to_num(0.0).clamp(0.0, 1e6).long().unbind(-1)
    rows, columns = rows.clamp(max=len(distances) - 1), columns.clamp(max=distances.shape[1] - 1)
    own = distances[rows, columns].masked_fill(~is_seen, torch.inf)
    away = (points - cameras.camera_to_world[view, :, 3]).norm(dim=-1)
    return least[rows, columns], own, away
