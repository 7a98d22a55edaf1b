"""What a view tells of cells of space: whether it sees them, looks through them, or sees something all over them.

The footprint of a cell is the bounding rectangle of its projection, rounded outwards.

Notation: `M` cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32

from unmix_plugin.engine.geometry.cameras import Cameras, distort, undistort

Centres = Float32[np.ndarray, "3 M"]
_Bounds = Float32[np.ndarray, "2 M"]
_Cells = Bool[np.ndarray, " M"]
_Counts = Int32[np.ndarray, " M"]
_MARGIN_PX = 1.5
"""Around what a row of a line camera sees of a cell."""
_PIXEL_MARGIN = 1.0
"""Pixels around a footprint that must be empty too: alpha is quantised and poses are not exact."""
_BORDER_POINTS = 65
"""Points along each image edge when its undistorted bounds are sought."""


@dataclass(frozen=True)
class Judged:
    """What a view tells of cells."""

    sees: _Cells
    """A part may be seen, beyond the near plane."""
    looks_through: _Cells | None
    """Only background is seen where it is; None without alpha."""
    is_settled: _Cells | None
    """So it tells of each part, too: none is seen, or all of them are and none is looked through. None if unknown."""


class _Covered:
    """Running sums of foreground pixels, so that any rectangle of a view is counted with four look-ups."""

    def __init__(self, foreground: Bool[np.ndarray, "H W"]) -> None:
        height, width = foreground.shape
        sums = np.zeros((height + 1, width + 1), dtype=np.int32)
        np.cumsum(np.cumsum(foreground, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
        self._sums, self._columns = sums.reshape(-1), width + 1

    def count(self, low: _Bounds, high: _Bounds) -> tuple[_Counts, _Counts]:
        """Foreground pixels and all pixels of rectangles within the view, rounded outwards."""
        (x0, y0), (x1, y1) = low.astype(np.int32), high.astype(np.int32) + 1
        every = (x1 - x0) * (y1 - y0)
        # One array of row-major corner numbers and `take` cost a third of two-dimensional indexing.
        y0, y1, sums = y0 * self._columns, y1 * self._columns, self._sums
        return sums.take(y1 + x1) - sums.take(y0 + x1) - sums.take(y1 + x0) + sums.take(y0 + x0), every


class PixelView:
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

    def judge(self, centres: Centres, half: Float32[np.ndarray, "3"], near: float) -> Judged:
        """Of cells with these centres, half as wide as `half`; nothing nearer than `near` is seen."""
        local = self._axes @ (centres - self._position[:, None])
        reach = np.abs(self._axes) @ half
        nearest, farthest = local[2] - reach[2], local[2] + reach[2]
        # Cells that reach behind the camera get a huge rectangle; whether they are empty depends on the depth too.
        front, back = np.maximum(nearest, 1e-6), np.maximum(farthest, 1e-6)
        low, high = local[:2] - reach[:2, None], local[:2] + reach[:2, None]
        low = np.where(low < 0.0, low / front, low / back)
        high = np.where(high > 0.0, high / front, high / back)
        overlaps = (high > self._low) & (low < self._high)
        shares_pixels = overlaps[0] & overlaps[1]
        sees = shares_pixels & (farthest > near)
        if self.covered is None:
            return Judged(sees, None, None)
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
        shown, every = self.covered.count(low.take(fits, axis=1), high.take(fits, axis=1))
        empty, is_settled, chosen = np.zeros(len(nearest), dtype=bool), ~shares_pixels, chosen.take(fits)
        empty[chosen] = shown == 0
        # Footprints of parts lie within that of the whole.
        is_settled[chosen] = (shown == every) & (nearest.take(chosen) > near)
        return Judged(sees, empty, is_settled)


class LineView:
    """As `PixelView`, of a line camera: the ball around a cell is looked up, where its middle is seen.

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

    def judge(self, centres: Centres, half: Float32[np.ndarray, "3"], near: float) -> Judged:
        """As `PixelView` does."""
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
            return Judged(sees, None, None)
        chosen = np.flatnonzero((low >= 0).all(axis=0) & (high[0] < self._columns) & (high[1] < self._rows))
        empty = np.zeros(len(sees), dtype=bool)
        empty[chosen] = self.covered.count(low[:, chosen], high[:, chosen])[0] == 0
        return Judged(sees, empty, None)
