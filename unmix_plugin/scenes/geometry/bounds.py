"""The box of space to model, found from the training views.

With alpha: the hull of what is not transparent decides. Without, nothing but the cameras is known, and the box rests
on how people frame pictures: the subject is where the optical axes meet, and is about as deep as the images are wide
there. So the box starts as a cube around the point nearest to all axes (least squares), its half edge a little more
than half the width of the images at that distance. If all cameras look from one side, nothing can be between them
and their subject but things are seen behind it, and the cube moves away from them. It is then cut to what a third of
the cameras see. Axes that are nearly parallel or miss each other, as those of a flight over land, have no such point;
then places that views agree on decide, and how far the views reach at their distance. Where there are too few such
places, parallel cameras get a cube in front of their middle, at a depth where most of their views overlap.

Notation: poses are camera to world, OpenGL axes, float64; `N` training cameras.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64, Int64

from unmix_plugin.engine.geometry.camera_paths import focus_point
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.geometry.carving import (
    MIN_EXPLAINED,
    Cells,
    Masks,
    carve_box,
    count_views,
    foreground_rays,
    share_through,
    unit_centres,
)
from unmix_plugin.scenes.geometry.matched_points import MatchedPoints
from unmix_plugin.scenes.messages import Message

_OUTLIERS = 0.005
"""Share of the matched places that may lie outside the box, at each of its sides."""
_PLACES_MARGIN = 0.05
"""By how much the box of places is wider, in their median depth: little that stands on the ground is matched."""
_FRAME_MARGIN = 1.2
"""The cube of views over the width of the images at the focus."""
_SHIFT_BEHIND = 0.2
"""How far the cube moves away from cameras that all look one way, over half that width; a ring of cameras moves it
little, since its directions cancel."""
_HULL_CELLS = 64
"""Cells along an edge when the hull's extent is sought."""
_HULL_SHARES = (2.0 / 3.0, 1.0 / 3.0)
"""Tried in turn: the hull's cells count for its extent if this share of the cameras that see its best seen cell see
them, as long as the box still explains the images."""
_MIN_CONSISTENT = 0.5
"""Least share of the foreground pixels that must have hull behind them: only gross contradictions fall below, since
masks that are a little off keep far more."""
_HULL_START = 1.25
"""The first box of the hull over the cameras' cube: room for things that reach out of the images."""
_SEEN_SHARE = 1.0 / 3.0
"""Share of the training cameras that must see a place for it to belong to the box."""
_SEEN_CELLS = 32
"""Cells along an edge when the region that cameras share is sought."""


def find_bounds(cameras: Cameras, foreground: Masks | None, points: MatchedPoints | None = None) -> SceneBox:
    """The box that the training views show, in their cameras' space, which has coordinates of order 1.

    Args:
        foreground: For each view True where it may show something; None where there is no alpha.
        points: By the numbers of these cameras, places that views agree on, for cameras that do not look at one place.
    Raises:
        SceneError: with alpha, no place is opaque in all views that see it: poses and pictures contradict.
    """
    if foreground is None and points is not None:
        return _box_of_places(cameras, points)
    centre, half = _cube_of_views(cameras)
    if foreground is None:
        box = _box(centre - half, centre + half)
        everywhere = np.ones((_SEEN_CELLS,) * 3, dtype=bool)
        is_shared = _count_views(cameras, box, everywhere) >= _SEEN_SHARE * len(cameras)
        return _extent(box, is_shared, margin_cells=0) if is_shared.any() else box
    rays = foreground_rays(cameras, foreground)
    box = _box(centre - _HULL_START * half, centre + _HULL_START * half)
    hull = carve_box(cameras, foreground, box, _HULL_CELLS)
    # Near a camera that looks out of the others' images everything is consistent, so only shared places count.
    count = _count_views(cameras, box, hull)
    explained = share_through(rays, box, hull & (count >= _HULL_SHARES[0] * count.max()))
    if explained < _MIN_CONSISTENT:
        raise SceneError(Message.ALPHA_AND_POSES.sentence(share=explained))
    box = _tight(box, hull, count, rays)
    # The second look has finer cells and so a thinner margin. It may find that nothing fits after all.
    hull = carve_box(cameras, foreground, box, _HULL_CELLS)
    return _tight(box, hull, _count_views(cameras, box, hull), rays) if hull.any() else box


def _box_of_places(cameras: Cameras, points: MatchedPoints) -> SceneBox:
    """What the nearer of the places span; where nothing lies behind them, all that the views show at their depth."""
    near = points.nearer
    places, margin = near.places.double().numpy(), _PLACES_MARGIN * float(near.depths.median())
    low, high = np.quantile(places, (_OUTLIERS, 1 - _OUTLIERS), axis=0)
    if points.are_equally_far:
        ends = []  # corners of each view, as deep as most of the places that it shows
        for view in range(len(cameras)):
            depths = near.depths[near.views == view]
            depth = float((depths if len(depths) else near.depths).median())
            width, height = cameras.size(view)
            coords = torch.tensor([(x, y) for x in (0.0, float(width)) for y in (0.0, float(height))])
            rays = cameras.generate_rays(torch.full((4,), view), coords)
            assert rays.axes is not None
            away = depth / (rays.directions * rays.axes).sum(dim=-1)
            ends.append(rays.at(away))
        corners = torch.cat(ends).double().numpy()
        low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    return _box(low - margin, high + margin)


def _cube_of_views(cameras: Cameras) -> tuple[Float64[np.ndarray, "3"], float]:
    poses = cameras.camera_to_world.double().numpy()
    positions, forward = poses[:, :, 3], -poses[:, :, 2]
    sides = np.array([cameras.size(index) for index in range(len(cameras))], dtype=np.float64)
    half_angles = (0.5 * sides / cameras.focal_px.double().numpy()).max(axis=-1)
    focus = focus_point(poses)
    if focus is not None:
        depths = ((focus - positions) * forward).sum(axis=-1)
        ahead = depths > 0.0
        half = float(np.median((depths * half_angles)[ahead]))
        return focus + _SHIFT_BEHIND * half * forward.mean(axis=0), _FRAME_MARGIN * half
    middle = positions.mean(axis=0)
    spread = float(np.linalg.norm(positions - middle, axis=-1).max())
    direction = forward.mean(axis=0)
    length = float(np.linalg.norm(direction))
    if length < 0.1:  # views in all directions: the box holds the cameras and as much again around them
        return middle, 2.0 * spread if spread > 0.0 else 1.0
    half = 2.0 * spread if spread > 0.0 else 1.0
    depth = half / float(np.median(half_angles))
    return middle + direction / length * depth, half


def _tight(box: SceneBox, hull: Cells, count: Int64[np.ndarray, "R R R"], rays: RayBundle) -> SceneBox:
    """The extent of the hull in a box, without its far ends that few cameras see, if the images allow.

    Where views are cropped the hull has long arms that reach from the subject to the edge of what is seen.
    """
    for share in _HULL_SHARES:
        tight = _extent(box, hull & (count >= share * count.max()), margin_cells=1)
        t_near, t_far = tight.intersect(rays.origins, rays.directions)
        if float((t_far > t_near).double().mean()) >= MIN_EXPLAINED:
            return tight
    return _extent(box, hull, margin_cells=1)


def _count_views(cameras: Cameras, box: SceneBox, asked: Cells) -> Int64[np.ndarray, "R R R"]:
    """How many cameras see the centre of each cell that is asked for; 0 for others."""
    points = box.aabb[0] + unit_centres(len(asked))[torch.from_numpy(asked).flatten()] * box.size
    count = np.zeros(asked.shape, dtype=np.int64)
    count[asked] = count_views(cameras, points).numpy()
    return count


def _extent(box: SceneBox, kept: Cells, margin_cells: int) -> SceneBox:
    """The smallest box around the kept cells, wider by a margin but never beyond the old box."""
    low, size = box.aabb[0].double().numpy(), box.size.double().numpy()
    new_low, new_high = np.zeros(3), np.zeros(3)
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        cells = np.flatnonzero(kept.any(axis=others))
        first, last = max(cells[0] - margin_cells, 0), min(cells[-1] + 1 + margin_cells, kept.shape[axis])
        new_low[axis] = low[axis] + size[axis] * first / kept.shape[axis]
        new_high[axis] = low[axis] + size[axis] * last / kept.shape[axis]
    return _box(new_low, new_high)


def _box(low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]) -> SceneBox:
    return SceneBox(torch.from_numpy(np.stack([low, high])).float())
