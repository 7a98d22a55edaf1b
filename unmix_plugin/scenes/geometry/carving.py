"""Which cells of space may be occupied, judged by the training views alone and before any training.

A cell stays if enough training cameras see it and, where pictures have alpha, no training view looks through it: a view
looks through a cell if the cell's whole footprint, widened by a margin, lies in the image on background. The footprint
is the bounding rectangle of the cell's projection, rounded outwards, so the hull is never too small. Masks may err:
where the hull leaves foreground unexplained, two views must look through a cell, or more.

What one or two views see is not held by the others, and what grows there fits single images only: with alpha half of
the views must see a cell, unless that leaves pixels unexplained, without alpha a tenth. In an unbounded world two views
are enough far away, where a small part of it fits into a view; near a camera more must agree.

Notation: `M` cells, `V` views, `R` cells along an edge; cells are indexed [x, y, z] from the box's smallest corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox, UnitSpace
from unmix_plugin.scenes.geometry.filters import without_specks
from unmix_plugin.scenes.geometry.footprints import LineView, PixelView
from unmix_plugin.scenes.geometry.views import look_up
from unmix_plugin.scenes.scene import Scene

Cells = Bool[np.ndarray, "R R R"]
"""Cells of a box that may be occupied."""
Masks = list[Bool[np.ndarray, "_ _"]]
"""For each view True on pixels that may show something."""
_MAX_RAYS = 20_000
"""Pixels that are asked for whether a hull explains them."""
MIN_EXPLAINED = 0.999
"""Share of the foreground pixels whose rays must cross what is kept."""
_NEAR_DEPTH = 0.05
"""Depth in front of a camera, as a share of the box's longest half edge, below which it sees nothing."""
_WITNESS_CELLS = 64
"""Cells along an edge of the hull that decides how many views must agree."""
COARSEST_CELLS = 16
"""Cells along an edge of the coarsest grid; finer ones look only inside what the coarser left."""
_FAIR_SHARE = 0.5
"""Share of the training views that must see a cell of a scene with alpha, unless that leaves foreground unexplained."""
_FAIR_SHARE_OPEN = 0.1
"""The same without alpha, where nothing tells what it leaves unexplained: only what hardly any view sees is carved,
since walls would be continued there into the void beside a room."""
_WITNESSES = (1, 2, 3, 4, 6, 8, 12)
"""Views that must look through a cell to carve it; more only where fewer leave foreground unexplained."""
_MOST_WITNESSES, _LARGEST_PART = 3, 0.3
"""Views that are asked to agree at most: so many, or that share of the training views if it is more."""
_BLOCK_CELLS = 1 << 15
"""Cells projected together; keeps temporaries within the processor's cache."""
_OCTANTS = np.indices((2, 2, 2), dtype=np.int32).reshape(3, -1)
"""Places of the parts of a cell."""
MOST_CONTRADICTED = 0.02
"""Share of the foreground that all masks together may carve away. Scenes with true poses have 0, with masks of which
some err 0.004 to 0.016, the demo scene with poses off by 3 px 0.007 and by 5 px 0.032."""
_WORLD_CELLS = 64
"""Cells along an edge of a contracted world in which visibility is judged; finer grids repeat it."""
_WORLD_SHARE = 0.05
"""Share of the training views that must see a cell, but two of them at least."""
_NEAR_SHARE = 0.2
"""The same of cells near a camera."""
_BESIDE_SHARE = 0.12
"""Share of the training views, but three of them at least, that must see a cell near a camera from the side from which
the nearest camera sees it. Views from the other side see another side of what is there, and hold nothing that fits the
nearest picture alone."""
_ONE_SIDE = 0.5
"""Cosine of the angle between views from one side, at least."""
_NEAR_DISTANCE = 0.6
"""What is near, in distances from the cameras to the middle of the box, median over cameras."""
_BLOCK_POINTS = 1 << 16
_STEPS_AT_A_TIME = 8
"""Along rays, before those that have met something are left out."""


def carve(
    scene: Scene, resolution: int, foreground: Masks | None = None, cameras: Cameras | None = None
) -> Cells:
    """Cells of the scene box, or of the world contracted around it, that may be occupied.

    Args:
        resolution: Cells along each edge of the box.
        foreground: For each training view True on pixels that may show something, whose hull is carved; None carves
            what hardly any training camera sees.
        cameras: Of the training views; None takes those of the scene.
    """
    cameras, box = scene.cameras[list(scene.train_indices)] if cameras is None else cameras, scene.scene_box
    if scene.is_unbounded:
        return _carve_world(cameras, box, resolution)
    if foreground is None:
        fewest_views = max(1, math.ceil(_FAIR_SHARE_OPEN * len(cameras)))
        return carve_box(cameras, None, box, resolution, fewest_views)
    return carve_by_masks(cameras, foreground, box, resolution)[0]


def carve_by_masks(
    cameras: Cameras, foreground: Masks, box: SceneBox, resolution: int
) -> tuple[Cells, float]:
    """As `carve` with foreground in a box, and the share of the foreground that is contradicted, as
    `share_contradicted` has it."""
    fair = max(1, math.ceil(_FAIR_SHARE * len(cameras)))
    rays = foreground_rays(cameras, [without_specks(mask) for mask in foreground])
    witnesses, explained = _needed_witnesses(cameras, foreground, box, rays)
    kept = carve_box(cameras, foreground, box, resolution, fair, witnesses)
    if share_through(rays, box, kept) < MIN_EXPLAINED:
        kept = carve_box(cameras, foreground, box, resolution, witnesses=witnesses)
    return kept, 1 - explained


def _needed_witnesses(
    cameras: Cameras, foreground: Masks, box: SceneBox, rays: RayBundle
) -> tuple[int, float]:
    """Views that must agree that a cell is empty, so that the hull explains what single views show; and the share of
    the rays that it explains where one view is enough.

    A hole in one mask carves away what all other views see; where masks are good, one view is enough. Where things move
    between views, as leaves do, many look through the place where some show a leaf.
    """
    shares: list[float] = []
    most = max(_MOST_WITNESSES, int(_LARGEST_PART * len(cameras)))
    for witnesses in [count for count in _WITNESSES if count <= most]:
        hull = carve_box(cameras, foreground, box, _WITNESS_CELLS, witnesses=witnesses)
        shares.append(share_through(rays, box, hull))
        if shares[-1] >= MIN_EXPLAINED:
            return witnesses, shares[0]
    return _WITNESSES[int(np.argmax(shares))], shares[0]


def carve_box(
    cameras: Cameras,
    foreground: Masks | None,
    box: SceneBox,
    resolution: int,
    fewest_views: int = 1,
    witnesses: int = 1,
) -> Cells:
    """Cells of a box that may be occupied, by the given views.

    Args:
        cameras: One a view, in the space of the box.
        foreground: For each view True on pixels that may show something; None where there is no alpha.
        fewest_views: Views that must see a cell for it to stay.
        witnesses: Views that must look through a cell for it to go.
    """
    views = [
        (LineView if cameras.is_line_camera(index) else PixelView)(
            cameras, index, None if foreground is None else foreground[index]
        )
        for index in range(len(cameras))
    ]
    sizes = [resolution]
    while sizes[-1] % 2 == 0 and sizes[-1] > COARSEST_CELLS:
        sizes.append(sizes[-1] // 2)
    kept = np.zeros((resolution,) * 3, dtype=bool)
    carver = _Carver(views, box, fewest_views, witnesses, kept)
    every = np.indices((sizes[-1],) * 3, dtype=np.int32).reshape(3, -1)
    for first in range(0, every.shape[1], _BLOCK_CELLS):
        block = every[:, first : first + _BLOCK_CELLS]
        count = block.shape[1]
        carver.carve(sizes[-1], block, np.ones((len(views), count), dtype=bool), np.zeros(count, np.int64))
    return kept


@dataclass(frozen=True)
class _Carver:
    """Divides the cells of a box that may be occupied until they are as small as asked."""

    views: list[PixelView | LineView]
    box: SceneBox
    fewest_views: int
    witnesses: int
    kept: Cells
    """Where those of the finest grid that stay become True."""

    def carve(
        self,
        cells: int,
        places: Int32[np.ndarray, "3 M"],
        unsettled: Bool[np.ndarray, "V M"],
        seen_by: Int64[np.ndarray, " M"],
    ) -> None:
        """Judge some cells of a grid, and the parts of those that may be occupied.

        Args:
            cells: Along an edge of the box.
            places: Which of them.
            unsettled: Views that may tell of a cell what they didn't tell of the one that it is a part of.
            seen_by: How many of the other views see it; these look through none of its parts.
        """
        size = self.box.size.numpy()
        near = _NEAR_DEPTH * 0.5 * float(self.box.size.max())
        steps = (places.astype(np.float32) + np.float32(0.5)) * (size / np.float32(cells))[:, None]
        centres, half = self.box.aabb[0].numpy()[:, None] + steps, size * np.float32(0.5 / cells)
        unsettled, settled_by, seen_by = unsettled.copy(), seen_by.copy(), seen_by.copy()
        stays, looked_through = np.ones(len(seen_by), dtype=bool), np.zeros_like(seen_by)
        for view, is_unsettled in zip(self.views, unsettled, strict=True):
            # With alpha every cell left is looked at by every view; without, only those too few have seen yet.
            is_asked = stays if view.covered is not None else seen_by < self.fewest_views
            asked = np.flatnonzero(is_asked & is_unsettled)
            judged = view.judge(centres.take(asked, axis=1), half, near)
            seen_by[asked] += judged.sees
            if judged.is_settled is not None:
                is_unsettled[asked] = ~judged.is_settled
                settled_by[asked] += judged.sees & judged.is_settled
            if judged.looks_through is not None:
                looked_through[asked] += judged.looks_through
                stays[asked] = looked_through[asked] < self.witnesses
        kept = np.flatnonzero(stays & (seen_by >= self.fewest_views))
        if cells == len(self.kept):
            self.kept[tuple(places.take(kept, axis=1))] = True
            return
        for first in range(0, len(kept), _BLOCK_CELLS // 8):
            block = kept[first : first + _BLOCK_CELLS // 8]
            parts = (2 * places[:, block, None] + _OCTANTS[:, None]).reshape(3, -1)
            self.carve(2 * cells, parts, unsettled[:, block].repeat(8, axis=1), settled_by[block].repeat(8))


def foreground_rays(cameras: Cameras, foreground: Masks) -> RayBundle:
    """Rays through foreground pixels, evenly thinned out to at most `_MAX_RAYS`."""
    flat = np.flatnonzero(np.concatenate([mask.reshape(-1) for mask in foreground]))
    chosen = flat[:: max(1, -(-len(flat) // _MAX_RAYS))]
    starts = np.cumsum([0, *(mask.size for mask in foreground)])
    views = np.searchsorted(starts, chosen, side="right") - 1
    widths = np.array([mask.shape[1] for mask in foreground])[views]
    rows, columns = np.divmod(chosen - starts[views], widths)
    coords = torch.from_numpy(np.stack([columns, rows], axis=-1)).float() + 0.5
    return cameras.generate_rays(torch.from_numpy(views), coords)


def share_through(rays: RayBundle, box: SceneBox, hull: Cells) -> float:
    """Share of the rays that meet a cell of the hull; 0 without rays."""
    if len(rays) == 0:
        return 0.0
    cells, kept = hull.shape[0], torch.from_numpy(hull).flatten()
    t_near, t_far = box.intersect(rays.origins, rays.directions)
    # Rays that have met none; an axis a row: what is done to every ray then runs along memory.
    left = (t_far > t_near).nonzero()[:, 0]
    num_missing = len(rays) - len(left)
    low, size = box.aabb[0, :, None], box.size[:, None]
    for steps in torch.linspace(0.0, 1.0, 2 * cells).split(_STEPS_AT_A_TIME):
        origins, directions = rays.origins[left].T.contiguous(), rays.directions[left].T.contiguous()
        first, length = t_near[left], t_far[left] - t_near[left]
        meets = torch.zeros(len(left), dtype=torch.bool)
        for step in steps:
            points = origins + (first + step * length) * directions
            x, y, z = ((points - low) / size * cells).long().clamp_(0, cells - 1)
            meets |= kept.take((x * cells + y) * cells + z)
        left = left[~meets]
    return (len(rays) - num_missing - len(left)) / len(rays)


def _carve_world(cameras: Cameras, box: SceneBox, resolution: int) -> Cells:
    """Cells of the world contracted around a box that enough training cameras see; arguments as `carve_box` has."""
    cells = min(resolution, _WORLD_CELLS)
    points = UnitSpace(box, is_unbounded=True).from_unit(unit_centres(cells))
    seen_by = torch.cat([count_views(cameras, part) for part in points.split(_BLOCK_POINTS)])
    positions = cameras.camera_to_world[:, :, 3]
    limit = _NEAR_DISTANCE * float((positions - box.aabb.mean(dim=0)).norm(dim=-1).median())
    nearest = torch.cat([torch.cdist(part, positions).amin(dim=1) for part in points.split(_BLOCK_POINTS)])
    near, far, beside = (
        min(max(fewest, math.ceil(share * len(cameras))), len(cameras))
        for fewest, share in ((2, _NEAR_SHARE), (2, _WORLD_SHARE), (3, _BESIDE_SHARE))
    )
    kept = seen_by >= torch.where(nearest < limit, near, far)
    asked = (kept & (nearest < limit)).nonzero()[:, 0]
    for part in asked.split(_BLOCK_POINTS // 8):
        kept[part] = _count_beside_nearest(cameras, points[part]) >= beside
    kept = kept.view(1, 1, cells, cells, cells)
    # A cell counts by its centre, so those beside one that is seen may be seen in part.
    grown = torch.nn.functional.max_pool3d(kept.float(), 3, stride=1, padding=1)[0, 0] > 0
    return refined(grown, resolution).numpy()


def _count_beside_nearest(cameras: Cameras, points: Float[Tensor, "P 3"]) -> Int64[Tensor, " P"]:
    """How many cameras see each point from the side from which the nearest of them does, that one included."""
    is_seen = torch.stack([look_up(cameras, index, points)[2] for index in range(len(cameras))])
    towards = cameras.camera_to_world[:, None, :, 3] - points
    nearest = towards.norm(dim=-1).masked_fill(~is_seen, torch.inf).argmin(dim=0)
    towards = torch.nn.functional.normalize(towards, dim=-1) * is_seen[..., None]
    first = towards[nearest, torch.arange(len(points))]
    return ((towards * first).sum(dim=-1) > _ONE_SIDE).sum(dim=0)


def unit_centres(cells: int) -> Float[Tensor, "M 3"]:
    """Centres of the cells of a unit cube, so many along each edge; x outermost."""
    return torch.cartesian_prod(*[(torch.arange(cells) + 0.5) / cells] * 3)


def refined(grid: Bool[Tensor, "r r r"], resolution: int) -> Bool[Tensor, "R R R"]:
    """The same grid in more cells."""
    index = torch.arange(resolution) * len(grid) // resolution
    return grid[index][:, index][:, :, index]


def count_views(cameras: Cameras, points: Float[Tensor, "P 3"]) -> Int64[Tensor, " P"]:
    """How many cameras see each point."""
    count = torch.zeros(len(points), dtype=torch.int64)
    for index in range(len(cameras)):
        count += look_up(cameras, index, points)[2]
    return count


def share_explained(scene: Scene, hull: Cells, foreground: Masks, cameras: Cameras) -> float:
    """Share of the training views' foreground behind which a hull in the scene's box has something."""
    rays = foreground_rays(cameras, [without_specks(mask) for mask in foreground])
    return share_through(rays, scene.scene_box, hull)


def share_contradicted(cameras: Cameras, foreground: Masks, box: SceneBox) -> float:
    """Share of the foreground behind which, all through the box, other views see only background; at most
    `MOST_CONTRADICTED` where poses and masks are right."""
    rays = foreground_rays(cameras, [without_specks(mask) for mask in foreground])
    return 1 - share_through(rays, box, carve_box(cameras, foreground, box, _WITNESS_CELLS))
