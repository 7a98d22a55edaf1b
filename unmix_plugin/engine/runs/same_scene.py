"""Whether two descriptions of a scene mean the same: exact but for numbers, which machines round differently."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

RELATIVE_TOLERANCE = 1e-4
"""Of numbers, against the greatest of the list that they are in."""
MOST_NAMED = 5
"""Differences that a message names."""


def differences(expected: Any, found: Any, name: str = "") -> list[str]:
    """What differs between two JSON-like values, each as the name of its place; empty if nothing does.

    Args:
        expected, found: Dictionaries, lists, tuples, strings, numbers, booleans, None, nested as they like.
        name: Of the values themselves.

    >>> differences({"size": [64, 48], "box": 1.0}, {"size": [64, 32], "box": 1.0 + 1e-9})
    ['size']
    """
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        keys = dict.fromkeys([*expected, *found])
        return [
            place
            for key in keys
            for place in (
                differences(expected[key], found[key], f"{name}.{key}" if name else str(key))
                if key in expected and key in found
                else [f"{name}.{key}" if name else str(key)]
            )
        ]
    return [] if _agree(expected, found) else [name]


def name_differences(places: list[str]) -> str:
    """Differences for a message, the first ones by name.

    >>> name_differences(["cameras", "frames"])
    'cameras, frames differ'
    """
    hidden = len(places) - MOST_NAMED
    return ", ".join(places[:MOST_NAMED]) + (f" and {hidden} more differ" if hidden > 0 else " differ")


def _agree(expected: Any, found: Any) -> bool:
    a, b = _as_numbers(expected), _as_numbers(found)
    if a is not None and b is not None:
        if a.shape != b.shape:
            return False
        scale = max(float(np.abs(a).max(initial=0.0)), float(np.abs(b).max(initial=0.0)))
        return bool((np.abs(a - b) <= RELATIVE_TOLERANCE * scale).all())
    if isinstance(expected, list | tuple) and isinstance(found, list | tuple):
        return len(expected) == len(found) and not any(map(differences, expected, found))
    return type(expected) is type(found) and expected == found


def _as_numbers(value: Any) -> np.ndarray | None:
    """A number, or an array of numbers of any shape; None for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None
