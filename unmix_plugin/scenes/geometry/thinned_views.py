"""Views with fewer pixels, for what is sought in them before training.

Notation: `H x W` pixels of a view, `h x w` of it thinned out, `B` bands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras

MOST_BANDS = 32
"""Of what is compared."""
MOST_POOLED = 4
"""Pixels along an edge that are averaged, if there are so many; of more, every second or third is left out."""

ReadView = Callable[[int, tuple[slice, ...]], Float32[np.ndarray, "H W B"]]
"""From a view, and the rows, columns and bands wanted, to its picture."""


@dataclass(frozen=True)
class Thinning:
    """Which pixels of a view are averaged to one."""

    fine: int
    """Of so many pixels along an edge one is read."""
    pooled: int
    """Of so many that are read along an edge the mean is taken."""
    band_step: int
    """Of so many bands one is read."""

    @classmethod
    def to(
        cls, longest_side_px: int, cameras: Cameras, read_view: ReadView, most_pooled: int = MOST_POOLED
    ) -> Thinning:
        """Of views that show the same bands to at most so many pixels along their longer side, and `MOST_BANDS`."""
        stride = -(-max(cameras.width, cameras.height) // longest_side_px)
        fine = max(1, stride // most_pooled)
        bands = read_view(0, (slice(1), slice(1))).shape[2]
        return cls(fine, stride // fine, -(-bands // MOST_BANDS))

    @property
    def stride(self) -> int:
        """Pixels of the whole view from one pixel of the thinned-out one to the next."""
        return self.fine * self.pooled

    @property
    def first(self) -> float:
        """Where in the whole view the first lies, from the centre of its first pixel on."""
        return self.fine * (self.pooled - 1) / 2

    def read(self, read_view: ReadView, view: int) -> Float[Tensor, "h w B"]:
        """A view thinned out."""
        some = slice(None, None, self.fine)
        picture = read_view(view, (some, some, slice(None, None, self.band_step)))
        image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)
        return torch.nn.functional.avg_pool2d(image, self.pooled).permute(1, 2, 0)

    def whole(self, coords: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Coordinates in the whole view of those in the thinned-out one; pixel centres are at + 0.5 in both."""
        return (coords - 0.5) * self.stride + self.first + 0.5
