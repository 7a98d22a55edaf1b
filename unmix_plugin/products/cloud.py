"""Clouds of points: outliers, normals, and fewer points that still cover everything evenly.

Notation: `P` points. Any units.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int64

_OUTLIER_NEIGHBOURS = 8
_OUTLIER_FACTOR = 4.0
"""Points whose neighbours are, on average, farther by this factor than those of the median point, are outliers."""

_PLANE_NEIGHBOURS = 24
_CHUNK = 50_000
_BISECTIONS = 20


def is_outlier(positions: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
    """Which points lie far from all others, by the mean distance to their nearest eight."""
    if len(positions) <= _OUTLIER_NEIGHBOURS:
        return np.zeros(len(positions), dtype=bool)
    from scipy.spatial import KDTree

    distances, _ = KDTree(positions).query(positions, k=_OUTLIER_NEIGHBOURS + 1)
    to_others = distances[:, 1:].mean(axis=1)
    return to_others > _OUTLIER_FACTOR * np.median(to_others)


def thinned(positions: Float[np.ndarray, "P 3"], count: int) -> Int64[np.ndarray, " kept"]:
    """Indices of at most `count` points, evenly spread: of each cube of a grid, the point nearest to their mean.

    The grid is the finest that has not more than `count` cubes with points in them.
    """
    if len(positions) <= count:
        return np.arange(len(positions))
    low = positions.min(axis=0)
    extent = float((positions - low).max())
    fine, coarse = 0.0, 2.0 * max(extent, 1e-12)
    for _ in range(_BISECTIONS):
        edge = (fine + coarse) / 2
        cubes = len(np.unique(_cube_numbers(positions - low, edge)))
        fine, coarse = (fine, edge) if cubes <= count else (edge, coarse)
    return np.sort(_nearest_to_means(positions, _cube_numbers(positions - low, coarse)))


def plane_normals(
    positions: Float[np.ndarray, "P 3"],
    towards: Float[np.ndarray, "P 3"],
    wanted: Int64[np.ndarray, " chosen"],
) -> Float[np.ndarray, "chosen 3"]:
    """Unit normals of the planes through the neighbours of some points.

    Args:
        positions: All points.
        towards: Directions, of which a point's normal makes an acute angle with its own.
        wanted: Points to have normals of.
    """
    if len(positions) < 3:
        return _unit(towards[wanted])
    from scipy.spatial import KDTree

    tree = KDTree(positions)
    count = min(_PLANE_NEIGHBOURS, len(positions))
    normals = np.empty((len(wanted), 3))
    for start in range(0, len(wanted), _CHUNK):
        chosen = wanted[start : start + _CHUNK]
        _, neighbours = tree.query(positions[chosen], k=count)
        around = positions[neighbours]
        around = around - around.mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(around.swapaxes(1, 2) @ around)
        normals[start : start + _CHUNK] = axes[:, :, 0]
    flipped = (normals * towards[wanted]).sum(axis=1) < 0
    normals[flipped] *= -1
    return normals


def _cube_numbers(offsets: Float[np.ndarray, "P 3"], edge: float) -> Int64[np.ndarray, " P"]:
    cells = (offsets / edge).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    return (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]


def _nearest_to_means(
    positions: Float[np.ndarray, "P 3"], cubes: Int64[np.ndarray, " P"]
) -> Int64[np.ndarray, " kept"]:
    _, group, counts = np.unique(cubes, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, weights=column) for column in positions.T], axis=1)
    off = np.linalg.norm(positions - (sums / counts[:, None])[group], axis=1)
    order = np.lexsort((off, group))
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return order[firsts]


def _unit(vectors: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(min=1e-12)
