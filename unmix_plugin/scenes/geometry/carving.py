"""Which cells of space may be occupied, judged by the training views alone and before any training.

A cell stays if enough training cameras see it and, where pictures have alpha, no training view looks through it: a view
looks through a cell if the cell's whole footprint, widened by a margin, lies in the image on background. The footprint
is the bounding rectangle of the cell's projection, rounded outwards, so the hull is never too small. Masks may err:
where the hull leaves foreground unexplained, two views must look through a cell, or more.

What one or two views see is not held by the others, and what grows there fits single images only: with alpha half of
the views must see a cell, unless that leaves pixels unexplained, without alpha a tenth. In an unbounded world two views
are enough far away, where a small part of it fits into a view; near a camera more must agree.

Notation: `M` cells, `R` cells along an edge; cells are indexed [x, y, z] from the box's smallest corner.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras, distort, undistort
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox, UnitSpace
from unmix_plugin.scenes.geometry.views import look_up
from unmix_plugin.scenes.scene import Scene

Cells = Bool[np.ndarray, "R R R"]
"""Cells of a box that may be occupied."""
Masks = list[Bool[np.ndarray, "_ _"]]
"""For each view True on pixels that may show something."""
_Centres = Float32[np.ndarray, "3 M"]
_Bounds = Float32[np.ndarray, "2 M"]
_Judged = tuple[Bool[np.ndarray, " M"], Bool[np.ndarray, " M"] | None]
"""Cells of which a part may be seen, beyond the near plane, and those that are looked through, if known."""
_MAX_RAYS = 20_000
"""Pixels that are asked for whether a hull explains them."""
MIN_EXPLAINED = 0.999
"""Share of the foreground pixels whose rays must cross what is kept."""


_MARGIN_PX = 1.5
"""Around what a row of a line camera sees of a cell."""
_PIXEL_MARGIN = 1.0
"""Pixels around a footprint that must be empty too: alpha is quantised and poses are not exact."""
_NEAR_DEPTH = 0.05
"""Depth in front of a camera, as a share of the box's longest half edge, below which it sees nothing."""
_WITNESS_CELLS = 64
"""Cells along an edge of the hull that decides how many views must agree."""
COARSEST_CELLS = 16
"""Cells along an edge of the coarsest grid; finer ones look only inside what the coarser left."""
_BORDER_POINTS = 65
"""Points along each image edge when its undistorted bounds are sought."""
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
    fair = max(1, math.ceil(_FAIR_SHARE * len(cameras)))
    rays = foreground_rays(cameras, [_without_specks(mask) for mask in foreground])
    witnesses = _needed_witnesses(cameras, foreground, box, rays)
    kept = carve_box(cameras, foreground, box, resolution, fair, witnesses)
    if share_through(rays, box, kept) >= MIN_EXPLAINED:
        return kept
    return carve_box(cameras, foreground, box, resolution, witnesses=witnesses)


def _needed_witnesses(cameras: Cameras, foreground: Masks, box: SceneBox, rays: RayBundle) -> int:
    """Views that must agree that a cell is empty, so that the hull explains what single views show.

    A hole in one mask carves away what all other views see; where masks are good, one view is enough. Where things move
    between views, as leaves do, many look through the place where some show a leaf.
    """
    shares: list[float] = []
    most = max(_MOST_WITNESSES, int(_LARGEST_PART * len(cameras)))
    for witnesses in [count for count in _WITNESSES if count <= most]:
        hull = carve_box(cameras, foreground, box, _WITNESS_CELLS, witnesses=witnesses)
        shares.append(share_through(rays, box, hull))
        if shares[-1] >= MIN_EXPLAINED:
            return witnesses
    return _WITNESSES[int(np.argmax(shares))]


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
    views: list[_View | _LineView] = []
    for index in range(len(cameras)):
        kind = _LineView if cameras.is_line_camera(index) else _View
        views.append(kind(cameras, index, None if foreground is None else foreground[index]))
    near = _NEAR_DEPTH * 0.5 * float(box.size.max())
    sizes = [resolution]
    while sizes[-1] % 2 == 0 and sizes[-1] > COARSEST_CELLS:
        sizes.append(sizes[-1] // 2)
    kept = np.ones((sizes[-1],) * 3, dtype=bool)
    for cells in reversed(sizes):
        if kept.shape[0] != cells:
            kept = kept.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
        low, size = box.aabb[0].numpy(), box.size.numpy()
        candidates = np.flatnonzero(kept)
        for first in range(0, len(candidates), _BLOCK_CELLS):
            block = candidates[first : first + _BLOCK_CELLS]
            index = np.stack(np.unravel_index(block, kept.shape)).astype(np.float32)
            centres = low[:, None] + (index + np.float32(0.5)) * (size / np.float32(cells))[:, None]
            half = size * np.float32(0.5 / cells)
            kept.reshape(-1)[block] = _may_be_occupied(centres, half, near, views, fewest_views, witnesses)
    return kept


def _may_be_occupied(
    centres: _Centres,
    half: Float32[np.ndarray, "3"],
    near: float,
    views: list[_View | _LineView],
    fewest_views: int,
    witnesses: int,
) -> Bool[np.ndarray, " M"]:
    """Of cells with these centres, half as wide as `half`; views see nothing nearer than `near`."""
    seen_by, looked_through = np.zeros((2, centres.shape[1]), dtype=np.int64)
    alive = np.arange(centres.shape[1])
    for view in views:
        # With alpha every cell left is looked at by every view; without, only those too few have seen yet.
        looked_at = alive if view.covered is not None else alive[seen_by[alive] < fewest_views]
        sees, looks_through = view.judge(centres.take(looked_at, axis=1), half, near)
        seen_by[looked_at] += sees
        if looks_through is not None:
            looked_through[alive] += looks_through
            alive = alive[looked_through[alive] < witnesses]
    result = np.zeros(centres.shape[1], dtype=bool)
    result[alive] = seen_by[alive] >= fewest_views
    return result


class _Covered:
    """Running sums of foreground pixels, so that any rectangle of a view is counted with four look-ups."""

    def __init__(self, foreground: Bool[np.ndarray, "H W"]) -> None:
        height, width = foreground.shape
        sums = np.zeros((height + 1, width + 1), dtype=np.int32)
        np.cumsum(np.cumsum(foreground, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
        self._sums, self._columns = sums.reshape(-1), width + 1

    def is_empty(self, low: _Bounds, high: _Bounds) -> Bool[np.ndarray, " M"]:
        """Whether rectangles within the view, rounded outwards, hold no foreground."""
        (x0, y0), (x1, y1) = low.astype(np.int32), high.astype(np.int32) + 1
        # One array of row-major corner numbers and `take` cost a third of two-dimensional indexing.
        y0, y1, sums = y0 * self._columns, y1 * self._columns, self._sums
        return sums.take(y1 + x1) - sums.take(y0 + x1) - sums.take(y1 + x0) + sums.take(y0 + x0) == 0


class _View:
    """One camera."""

    def __init__(self, cameras: Cameras, index: int, foreground: Bool[np.ndarray, "H W"] | None) -> None:
        pose = cameras.camera_to_world[index].numpy()
        # OpenCV axes here (x right, y down, z forward), so that image and depth have the signs of pixels
        self._axes = (pose[:, :3] * np.array([1.0, -1.0, -1.0], dtype=np.float32)).T
        self._position = pose[:, 3]
        self._focal = cameras.focal_px[index].numpy()[:, None]
        self._center = cameras.center_px[index].numpy()[:, None]
        self._distortion = cameras.distortion[index] if cameras.is_distorted else None
        self._sides = np.array(cameras.size(index), dtype=np.float32)[:, None]
        self._low, self._high = -self._center / self._focal, (self._sides - self._center) / self._focal
        if self._distortion is not None:
            # Bounds in ideal coordinates, from the image's border; far outside them a lens model folds over.
            along = np.linspace(0.0, 1.0, _BORDER_POINTS, dtype=np.float32)
            ends = np.repeat(np.array([0.0, 1.0], dtype=np.float32), _BORDER_POINTS)
            both = np.tile(along, 2)
            border = np.concatenate([np.stack([both, ends]), np.stack([ends, both])], axis=1) * self._sides
            distorted = torch.from_numpy(((border - self._center) / self._focal).T.copy())
            ideal = undistort(distorted, self._distortion).numpy()
            self._low, self._high = ideal.min(axis=0)[:, None], ideal.max(axis=0)[:, None]
        self.covered = None if foreground is None else _Covered(foreground)

    def judge(self, centres: _Centres, half: Float32[np.ndarray, "3"], near: float) -> _Judged:
        """Cells of which a part may be seen, beyond the near plane, and those that are looked through, if known."""
        local = self._axes @ (centres - self._position[:, None])
        reach = np.abs(self._axes) @ half
        nearest, farthest = local[2] - reach[2], local[2] + reach[2]
        # Cells that reach behind the camera get a huge rectangle; whether they are empty depends on the depth too.
        front, back = np.maximum(nearest, 1e-6), np.maximum(farthest, 1e-6)
        low, high = local[:2] - reach[:2, None], local[:2] + reach[:2, None]
        low = np.where(low < 0.0, low / front, low / back)
        high = np.where(high > 0.0, high / front, high / back)
        overlaps = (high > self._low) & (low < self._high)
        sees = overlaps[0] & overlaps[1] & (farthest > near)
        if self.covered is None:
            return sees, None
        inside = (low >= self._low) & (high <= self._high)
        chosen = np.flatnonzero(inside[0] & inside[1] & (nearest > 1e-6))
        low, high = low.take(chosen, axis=1), high.take(chosen, axis=1)
        if self._distortion is not None:
            # From corners, middles of edges and centres: a bulge between these is of second order in a cell's size and
            # stays within `_PIXEL_MARGIN`.
            columns, rows = (
                np.stack([low[axis], 0.5 * (low[axis] + high[axis]), high[axis]]) for axis in (0, 1)
            )
            points = np.stack(np.broadcast_arrays(columns[:, None], rows[None, :]), axis=-1)
            distorted = distort(torch.from_numpy(points), self._distortion).numpy().reshape(9, -1, 2)
            low, high = distorted.min(axis=0).T, distorted.max(axis=0).T
        low = low * self._focal + (self._center - _PIXEL_MARGIN)
        high = high * self._focal + (self._center + _PIXEL_MARGIN)
        fits = np.flatnonzero((low >= 0.0).all(axis=0) & (high < self._sides).all(axis=0))
        empty = np.zeros(len(nearest), dtype=bool)
        empty[chosen[fits]] = self.covered.is_empty(low.take(fits, axis=1), high.take(fits, axis=1))
        return sees, empty


class _LineView:
    """As `_View`, of a line camera: the ball around a cell is looked up, where its middle is seen.

    It reaches along the line by its width and across it as fast as the camera moves there.
    """

    def __init__(self, cameras: Cameras, index: int, foreground: Bool[np.ndarray, "H W"] | None) -> None:
        self._camera = cameras[index]
        self._columns, self._rows = cameras.size(index)
        self.covered = None if foreground is None else _Covered(foreground)
        y = torch.arange(self._rows + 1, dtype=torch.float32)
        poses = self._camera.poses_at(torch.zeros(len(y), dtype=torch.int64), y)
        up, back, places = poses[1:, :, 1], poses[:-1, :, 2], poses[:, :, 3]
        # From one row to the next, a point at depth d moves across the line by shift - d turn.
        self._shift = ((places[:-1] - places[1:]) * up).sum(dim=1)
        self._turn = (back * up).sum(dim=1)

    def judge(self, centres: _Centres, half: Float32[np.ndarray, "3"], near: float) -> _Judged:
        points, radius = torch.from_numpy(np.ascontiguousarray(centres.T)), float(np.linalg.norm(half))
        middle, depths = self._camera.project(points, 0)
        rows = middle[:, 1].long().clamp(0, self._rows - 1)
        speed = (self._shift[rows] - depths * self._turn[rows]).abs().clamp(min=1e-9)
        across = radius * self._camera.focal_px[0, 0] / depths.clamp(min=1e-6)
        reach = torch.stack([across, radius / speed]) + _MARGIN_PX
        unseen = depths <= 0
        low, high = ((middle.T + side * reach).masked_fill(unseen, torch.nan).numpy() for side in (-1, 1))
        sees = (high[0] > 0) & (low[0] < self._columns) & (depths.numpy() > near)
        if self.covered is None:
            return sees, None
        chosen = np.flatnonzero((low >= 0).all(axis=0) & (high[0] < self._columns) & (high[1] < self._rows))
        empty = np.zeros(len(sees), dtype=bool)
        empty[chosen] = self.covered.is_empty(low[:, chosen], high[:, chosen])
        return sees, empty


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
    cells = hull.shape[0]
    t_near, t_far = box.intersect(rays.origins, rays.directions)
    kept = torch.from_numpy(hull)
    meets = torch.zeros(len(rays), dtype=torch.bool)
    for step in torch.linspace(0.0, 1.0, 2 * cells):
        points = rays.origins + (t_near + step * (t_far - t_near))[:, None] * rays.directions
        x, y, z = (box.normalise(points) * cells).long().clamp(0, cells - 1).unbind(-1)
        meets |= kept[x, y, z] & (t_far > t_near)
    return float(meets.double().mean())


def _without_specks(foreground: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Foreground in squares of 2 x 2 pixels: single pixels in the air need no hull behind them.

    As `scipy.ndimage.binary_opening`, whose import takes half a second.
    """
    pairs = foreground[:-1] & foreground[1:]
    squares = pairs[:, :-1] & pairs[:, 1:]
    opened = np.zeros_like(foreground)
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            opened[rows, columns] |= squares
    return opened


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
    rays = foreground_rays(cameras, [_without_specks(mask) for mask in foreground])
    return share_through(rays, scene.scene_box, hull)


def share_contradicted(cameras: Cameras, foreground: Masks, box: SceneBox) -> float:
    """Share of the foreground behind which, all through the box, other views see only background; at most
    `MOST_CONTRADICTED` where poses and masks are right."""
    rays = foreground_rays(cameras, [_without_specks(mask) for mask in foreground])
    return 1 - share_through(rays, box, carve_box(cameras, foreground, box, _WITNESS_CELLS))
