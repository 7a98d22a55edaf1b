"""Filters of pictures and grids of cells, as `scipy.ndimage` has them, whose import takes as long as reading a scene.

Beyond the border lies the mirror image of what is within.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

_TRUNCATED = 4.0
"""Standard deviations at which a Gaussian ends."""


def without_specks(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """What lies in squares of 2 x 2 pixels that are all True: `binary_opening`."""
    pairs = mask[:-1] & mask[1:]
    squares = pairs[:, :-1] & pairs[:, 1:]
    opened = np.zeros_like(mask)
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            opened[rows, columns] |= squares
    return opened


def inner_cells(cells: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Cells whose six neighbours are True, too, as those beyond the border are: `binary_erosion`."""
    inner = cells.copy()
    for axis in range(3):
        own, neighbours = np.moveaxis(inner, axis, 0), np.moveaxis(cells, axis, 0)
        own[1:] &= neighbours[:-1]
        own[:-1] &= neighbours[1:]
    return inner


def mean_3x3(values: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Mean of 3 x 3 pixels: `uniform_filter`."""
    for axis in range(2):
        before, middle, after = _shifted(values, axis, 1)
        values = ((before + middle + after) / 3).astype(np.float32)
    return values


def gaussian_blur(values: Float32[np.ndarray, "X Y Z"], sigma: float) -> Float32[np.ndarray, "X Y Z"]:
    """Blur with this standard deviation, in cells: `gaussian_filter`."""
    radius = int(_TRUNCATED * sigma + 0.5)
    weights = np.exp(-0.5 / sigma**2 * np.arange(-radius, radius + 1) ** 2)
    weights /= weights.sum()
    for axis in range(3):
        shifted = _shifted(values, axis, radius)
        total = shifted[radius] * weights[radius]
        for away in range(radius):
            total += (shifted[away] + shifted[-1 - away]) * weights[away]
        values = total.astype(np.float32)
    return values


def _shifted(values: np.ndarray, axis: int, most: int) -> list[np.ndarray]:
    """The values in float64, shifted along an axis by -`most` to `most` places."""
    width = [(most, most) if own == axis else (0, 0) for own in range(values.ndim)]
    padded = np.moveaxis(np.pad(values.astype(np.float64), width, mode="symmetric"), axis, 0)
    count = values.shape[axis]
    return [np.moveaxis(padded[first : first + count], 0, axis) for first in range(2 * most + 1)]
