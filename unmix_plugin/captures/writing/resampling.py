"""Pictures brought from the lens of their file into that of the scene, while they are written.

Values are interpolated once, by cubic convolution, all bands alike: weights of 4 x 4 pixels, a sparse matrix. A pixel
is missing where the file's lens does not see it, or where one of the 2 x 2 pixels around it is missing.

Notation: `H x W` pixels, of which `h` rows are made at a time.
Source: Keys 1981, Cubic convolution interpolation for digital image processing, with a = -1/2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Shaped

from unmix_plugin.captures.calibration.calibration import CalibratedRows
from unmix_plugin.captures.poses.lens import Lens

_MOSTLY = 0.5
"""Share of saturated pixels among the 2 x 2 around one, by their bilinear weights, from which it counts as one."""


@dataclass(frozen=True)
class Resampling:
    """Where each pixel of a view lies in its file."""

    at: Float64[np.ndarray, "H W 2"]
    """Column and row, from the centre of the file's first pixel on."""
    inside: Bool[np.ndarray, "H W"]
    """Pixels that the file shows: not beyond the centres of its outermost pixels."""

    @staticmethod
    @lru_cache(maxsize=8)
    def into(lens: Lens) -> Resampling:
        """The resampling from the file's lens. Remembered, as the views of a camera share it."""
        at = lens.file_pixels() - 0.5
        last = np.array([lens.width - 1, lens.height - 1])
        inside = np.all((at >= 0) & (at <= last), axis=-1)  # false for NaN
        return Resampling(np.where(inside[..., None], at, 0.0), inside)

    def rows(self, first: int, last: int, read: Callable[[int, int], CalibratedRows]) -> CalibratedRows:
        """Rows `first` to `last` (excluded) of the view.

        Args:
            read: Gives rows of the file, from a first to a last (excluded).
        """
        at, inside = self.at[first:last], self.inside[first:last]
        down, top, bottom = at[..., 1][inside], 0, 1  # rows of the file that these are made of
        if len(down):
            top, bottom = max(0, int(down.min()) - 1), min(len(self.at), int(down.max()) + 3)
        part = read(top, bottom)
        shape = part.missing.shape
        at = at - (0, top)
        around = _weights(at, shape, _linear)
        missing = ~inside | ((around @ part.missing.ravel()).reshape(inside.shape) > 1e-6)
        # Missing pixels have no value: the others take their weights.
        weights = _weights(at, shape, _cubic)
        bands = part.values.shape[-1]
        values = weights @ part.values.reshape(-1, bands)
        if part.missing.any():
            values /= np.clip(weights @ ~part.missing.ravel(), 0.5, None)[:, None]
        saturated = around @ part.saturated.reshape(-1, bands) >= _MOSTLY
        values, saturated = (array.reshape(*inside.shape, bands) for array in (values, saturated))
        values[missing] = 0.0
        return CalibratedRows(values.astype(np.float32, copy=False), saturated & ~missing[..., None], missing)

    def nearest(self, picture: Shaped[np.ndarray, "H W"], outside: int) -> Shaped[np.ndarray, "H W"]:
        """A picture of labels or masks, each pixel that of the nearest one of the file."""
        columns, rows = np.rint(self.at).astype(int).transpose(2, 0, 1)
        return np.where(self.inside, picture[rows, columns], np.asarray(outside, picture.dtype))

    def smooth(self, picture: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "H W"]:
        """A picture of whole numbers, interpolated linearly; 0 outside."""
        found = _weights(self.at, picture.shape, _linear) @ picture.ravel()
        return np.where(self.inside, np.rint(found).reshape(picture.shape), 0).astype(picture.dtype)


def _linear(part: np.ndarray) -> np.ndarray:
    """Weights of two neighbours of points that lie `part` of the way from the first to the second."""
    return np.stack([1.0 - part, part], axis=-1)


def _cubic(part: np.ndarray) -> np.ndarray:
    """Weights of four neighbours of points that lie `part` of the way from the second to the third."""
    powers = np.stack([np.ones_like(part), part, part**2, part**3], axis=-1)
    return powers @ (0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]))


def _weights(at: Float64[np.ndarray, "h W 2"], shape: tuple[int, int], kernel: Callable[[Any], Any]) -> Any:
    """Matrix from the pixels of some rows of a file to those of the view; beyond an edge its pixels go on."""
    from scipy import sparse

    at = at.reshape(-1, 2)
    base = np.floor(at).astype(int)
    across, down = (kernel(at[:, axis] - base[:, axis]) for axis in (0, 1))
    reach = across.shape[1]
    steps = np.arange(reach) - (reach // 2 - 1)
    columns = np.clip(base[:, :1] + steps, 0, shape[1] - 1)
    rows = np.clip(base[:, 1:] + steps, 0, shape[0] - 1)
    places = rows[:, :, None] * shape[1] + columns[:, None, :]
    weights = (down[:, :, None] * across[:, None, :]).astype(np.float32)
    ends = np.arange(len(at) + 1) * reach * reach
    return sparse.csr_matrix((weights.ravel(), places.ravel(), ends), shape=(len(at), shape[0] * shape[1]))
