"""Where surfaces are in an unbounded world, as far as the training views agree on it before any training.

Notation: `R` drawn pixels, `N` training views, `h x w` pixels of a view that were asked.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.scenes.geometry.seen_through import seen_through
from unmix_plugin.scenes.geometry.swept_depths import SweptDepths, sweep_depths
from unmix_plugin.scenes.pixel_table import DrawnPixels
from unmix_plugin.scenes.scene import Scene

_CELLS = 64
"""Along an edge of the grid in which empty space is sought; finer grids repeat it."""


class SurfaceEvidence:
    """Distances of pixels that views agree on, and the space that they show to be empty."""

    def __init__(self, scene: Scene) -> None:
        """Compare the training views; of rigs and line cameras, and of bounded scenes, nothing is known."""
        self._cameras = scene.cameras[list(scene.train_indices)]
        self._box = scene.scene_box
        self._depths: SweptDepths | None = None
        if scene.is_unbounded and not scene.is_rig and self._cameras.key_poses is None:
            train = scene.train_indices
            self._depths = sweep_depths(
                self._cameras, self._box, lambda view, part: scene.cube(train[view], part)
            )

    @property
    def is_known(self) -> bool:
        """Whether views could be compared."""
        return self._depths is not None

    def carved(self, reachable: Bool[np.ndarray, "X X X"]) -> Bool[np.ndarray, "X X X"]:
        """Cells that may be occupied, without those that views look through."""
        if self._depths is None:
            return reachable
        cells = min(len(reachable), _CELLS)
        index = torch.arange(len(reachable)) * cells // len(reachable)
        empty = seen_through(self._depths, self._cameras, self._box, cells)
        return reachable & ~empty[index][:, index][:, :, index].numpy()

    def points(self, pixels: DrawnPixels) -> Float[Tensor, "R 3"]:
        """Places that drawn pixels show, model space; NaN where unknown."""
        assert self._depths is not None
        depths, device = self._depths, pixels.corners.device
        swept = torch.full((len(self._cameras),), -1)
        swept[list(depths.views)] = torch.arange(len(depths.views))
        views, corners = pixels.cameras.cpu(), pixels.corners.cpu()
        rays = self._cameras.generate_rays(views, corners + 0.5)
        columns, rows = (corners // depths.stride).unbind(-1)
        rows, columns = (
            at.clamp(max=side - 1)
            for at, side in zip((rows, columns), depths.distances.shape[1:], strict=True)
        )
        found = depths.distances[swept[views], rows, columns].masked_fill(swept[views] < 0, torch.inf)
        known = torch.where(torch.isfinite(found), found, torch.nan)
        return (rays.origins + known[:, None] * rays.directions).to(device)
