"""What a line camera sees of cells of space, and which it looks through: see `carving`.

A cell's ball is looked up: its middle, and its ends across the line. Between them the camera moves evenly enough.

Notation: `M` cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

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
        self._across = cameras.camera_to_world[index, :, 1]
        self.covered = covered

    def footprint(self, centres: Float32[np.ndarray, "3 M"], half: Float32[np.ndarray, "3"]) -> LineFootprint:
        """Where cells of these half edges are seen."""
        points, radius = torch.from_numpy(np.ascontiguousarray(centres.T)), float(np.linalg.norm(half))
        middle, depths = self._camera.project(points, 0)
        ends = [self._heights(points + side * radius * self._across) for side in (-1.0, 1.0)]
        spread = torch.stack([*ends, middle[:, 1]])
        reach = radius * self._camera.focal_px[0, 0] / depths.clamp(min=1e-6) + _MARGIN_PX
        low = torch.stack([middle[:, 0] - reach, spread.amin(dim=0) - _MARGIN_PX])
        high = torch.stack([middle[:, 0] + reach, spread.amax(dim=0) + _MARGIN_PX])
        unseen = depths <= 0
        return LineFootprint(
            low.masked_fill(unseen, torch.nan).numpy(),
            high.masked_fill(unseen, torch.nan).numpy(),
            depths.numpy(),
        )

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

    def _heights(self, points: Tensor) -> Tensor:
        """y at which points are seen; infinite where no row sees them."""
        coords, depths = self._camera.project(points, 0)
        return coords[:, 1].masked_fill(depths <= 0, torch.inf)
