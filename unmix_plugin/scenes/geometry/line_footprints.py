"""What a line camera sees of cells of space, and which it looks through: see `carving`.

The ball around a cell is looked up: where its middle is seen, and how far it reaches along the line and, as fast as the
camera moves there, across it.

Notation: `M` cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32

from unmix_plugin.engine.geometry.cameras import Cameras

_MARGIN_PX = 1.5


@dataclass(frozen=True)
class LineFootprint:
    """Rectangles of pixels around projected cells, and their depths; NaN where no row sees a cell's middle."""

    low: Float32[np.ndarray, "2 M"]
    high: Float32[np.ndarray, "2 M"]
    depths: Float32[np.ndarray, " M"]


class LineView:
    """One line camera with the running sum of its foreground pixels."""

    def __init__(self, cameras: Cameras, index: int, covered: Int32[np.ndarray, " pixels"] | None) -> None:
        """`covered` holds sums over rectangles from the first pixel, (H + 1) x (W + 1) of them, row after row."""
        self._camera = cameras[index]
        self._columns, self._rows = cameras.size(index)
        self.covered = covered
        y = torch.arange(self._rows + 1, dtype=torch.float32)
        poses = self._camera.poses_at(torch.zeros(len(y), dtype=torch.int64), y)
        up, back, places = poses[1:, :, 1], poses[:-1, :, 2], poses[:, :, 3]
        # From one row to the next, a point at depth d moves across the line by shift - d turn.
        self._shift = ((places[:-1] - places[1:]) * up).sum(dim=1)
        self._turn = (back * up).sum(dim=1)

    def footprint(self, centres: Float32[np.ndarray, "3 M"], half: Float32[np.ndarray, "3"]) -> LineFootprint:
        """Where cells of these half edges are seen."""
        points, radius = torch.from_numpy(np.ascontiguousarray(centres.T)), float(np.linalg.norm(half))
        middle, depths = self._camera.project(points, 0)
        rows = middle[:, 1].long().clamp(0, self._rows - 1)
        speed = (self._shift[rows] - depths * self._turn[rows]).abs().clamp(min=1e-9)
        across = radius * self._camera.focal_px[0, 0] / depths.clamp(min=1e-6)
        reach = torch.stack([across, radius / speed]) + _MARGIN_PX
        unseen = depths <= 0
        low, high = ((middle.T + side * reach).masked_fill(unseen, torch.nan).numpy() for side in (-1, 1))
        return LineFootprint(low, high, depths.numpy())

    def sees(self, footprint: LineFootprint, near: float) -> Bool[np.ndarray, " M"]:
        """Cells of which at least a part may be in the image and beyond the near plane."""
        inside = (footprint.high[0] > 0) & (footprint.low[0] < self._columns)
        return inside & (footprint.depths > near)

    def looks_through(self, footprint: LineFootprint) -> Bool[np.ndarray, " M"]:
        """Cells whose whole footprint lies in the image, on background pixels."""
        assert self.covered is not None
        low, high = footprint.low, footprint.high
        inside = (low >= 0).all(axis=0) & (high[0] < self._columns) & (high[1] < self._rows)
        chosen = np.flatnonzero(inside)
        x0, y0 = low[:, chosen].astype(np.int32)
        x1, y1 = high[:, chosen].astype(np.int32) + 1
        sums = self.covered.reshape(self._rows + 1, self._columns + 1)
        empty = np.zeros(len(inside), dtype=bool)
        empty[chosen] = sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0] == 0
        return empty
