"""Cutting a mesh into charts: connected triangles that face about the same way, each seen flat along an axis.

Cutting by direction takes time proportional to the triangles and can't fail; no length in a chart shrinks below half.

Notation: `V` vertices, `F` triangles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_ROUNDS = 6
"""Rounds in which directions are averaged with those of neighbours, and small charts join others."""

_LEAST_COSINE = 0.3
"""Of a triangle's normal with the axis of a chart that it may join."""

_SMALL = 24
"""Triangles of a chart that had better join another one."""


def chart_labels(
    positions: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The chart of each triangle, counted from 0, and the axis (0 to 5) that each triangle is seen along."""
    normals, links = _normals(positions, faces), _links(faces)
    smooth = normals
    for _ in range(_ROUNDS):
        summed = smooth + links @ smooth
        smooth = summed / np.linalg.norm(summed, axis=1, keepdims=True).clip(1e-12)
    axes = _best(smooth @ _AXES.T, normals)
    for _ in range(_ROUNDS):
        charts, sizes = _components(axes, links)
        is_small = sizes[charts] < _SMALL
        if not is_small.any():
            break
        # Neighbours outside small charts vote on the axis of the triangles inside.
        votes = links @ (np.eye(6)[axes] * ~is_small[:, None])
        joins = is_small & (votes.max(axis=1) > 0)
        axes = np.where(joins, _best(votes, normals, axes), axes)
    return _components(axes, links)[0], axes


def chart_uv(positions: Float[np.ndarray, "N 3"], axes: Int[np.ndarray, " N"]) -> Float[np.ndarray, "N 2"]:
    """Points as they are seen along an axis each, in the positions' unit, not mirrored."""
    right = np.roll(np.abs(_AXES), 1, axis=1)
    up = np.cross(_AXES, right)
    return np.stack([(positions * right[axes]).sum(axis=1), (positions * up[axes]).sum(axis=1)], axis=1)


def _best(scores: np.ndarray, normals: np.ndarray, otherwise: np.ndarray | None = None) -> np.ndarray:
    """The axis of the highest score among those that a triangle faces; the nearest one where there is none."""
    cosines = normals @ _AXES.T
    allowed = (cosines > _LEAST_COSINE) & ((scores > 0) if otherwise is not None else True)
    chosen = np.where(allowed, scores, -np.inf).argmax(axis=1)
    return np.where(allowed.any(axis=1), chosen, cosines.argmax(axis=1) if otherwise is None else otherwise)


def _normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = positions[faces].swapaxes(0, 1)
    across = np.cross(b - a, c - a)
    return across / np.linalg.norm(across, axis=1, keepdims=True).clip(1e-30)


def _links(faces: np.ndarray) -> Any:
    """Symmetric matrix (F, F) that is 1 where triangles share an edge."""
    from scipy.sparse import coo_matrix

    count = len(faces)
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    _, edges = np.unique(ends[:, 0] * (ends.max() + 1) + ends[:, 1], return_inverse=True)
    sides = coo_matrix(
        (np.ones(3 * count), (np.repeat(np.arange(count), 3), edges)), dtype=np.float64
    ).tocsr()
    links = (sides @ sides.T).tocsr()
    links.setdiag(0)
    links.eliminate_zeros()
    links.data[:] = 1
    return links


def _components(axes: np.ndarray, links: Any) -> tuple[np.ndarray, np.ndarray]:
    """Charts: connected triangles of one axis; and how many triangles each has."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = links.tocoo()
    same = axes[pairs.row] == axes[pairs.col]
    joined = coo_matrix((pairs.data[same], (pairs.row[same], pairs.col[same])), shape=links.shape)
    _, charts = connected_components(joined, directed=False)
    return charts, np.bincount(charts)
