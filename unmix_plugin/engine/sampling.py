"""What stands for many: evenly spaced picks, and a deviation that outliers leave alone."""

from __future__ import annotations

import numpy as np


def evenly_spaced(count: int, most: int) -> list[int]:
    """Of `count` indices at most `most`, increasing, each once: both ends, and as evenly between them as can be.

    >>> evenly_spaced(10, 4), evenly_spaced(3, 12), evenly_spaced(0, 4)
    ([0, 3, 6, 9], [0, 1, 2], [])
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()


SIGMA_OF_MEDIAN_DEVIATION = 1.4826
"""Standard deviation over the median distance from the median, of normally distributed numbers."""


def robust_deviation(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    """Standard deviation by the median distance from the median, as of normally distributed numbers.

    >>> round(float(robust_deviation(np.array([1.0, 2.0, 3.0, 1000.0]))), 4)
    1.4826
    """
    away = np.abs(values - np.median(values, axis=axis, keepdims=True))
    return np.asarray(SIGMA_OF_MEDIAN_DEVIATION * np.asarray(np.median(away, axis=axis), np.float64))
