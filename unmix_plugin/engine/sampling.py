"""Evenly spaced picks of many."""

from __future__ import annotations

import numpy as np


def evenly_spaced(count: int, most: int) -> list[int]:
    """Of `count` indices at most `most`, increasing, each once: both ends, and as evenly between them as can be.

    >>> evenly_spaced(10, 4), evenly_spaced(3, 12), evenly_spaced(0, 4)
    ([0, 3, 6, 9], [0, 1, 2], [])
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()
