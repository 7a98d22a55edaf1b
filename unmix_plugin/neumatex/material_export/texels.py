"""Which point of a surface each texel shows, and textures filled beyond the charts.

Notation: `T` texels that lie in a chart, `F` triangles, `S x S` texels; texel (row, column) has its centre at
u = (column + 0.5) / S, v = (row + 0.5) / S.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from unmix_plugin.neumatex.material_export.atlas import Atlas

_CHUNK = 1 << 21
"""Texels of bounding boxes that are looked at together."""

_EDGE = 1e-6
"""Barycentric weight down to which a texel on an edge counts as inside."""


@dataclass(frozen=True)
class Texels:
    """Texels in charts, with the places of the surface that they show."""

    size: int
    """S."""
    places: Int[np.ndarray, " T"]
    """Row times S plus column; increasing, each once."""
    triangles: Int[np.ndarray, " T"]
    weights: Float[np.ndarray, "T 3"]
    """Of the triangle's corners, summing to 1."""

    def of_corners(self, values: Float[np.ndarray, "V C"], faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
        """Values of vertices interpolated at the texels, (T, C)."""
        return np.einsum("tk,tkc->tc", self.weights, values[faces[self.triangles]])

    def texture(self, values: Float[np.ndarray, "T C"]) -> np.ndarray:
        """Values of the texels as a texture (S, S, C); beyond the charts each texel has the value of the nearest."""
        from scipy.ndimage import distance_transform_edt

        outside = np.ones(self.size**2, dtype=bool)
        outside[self.places] = False
        picture = np.zeros((self.size**2, values.shape[1]), dtype=values.dtype)
        picture[self.places] = values
        nearest = distance_transform_edt(
            outside.reshape(self.size, self.size), return_distances=False, return_indices=True
        )
        assert isinstance(nearest, np.ndarray)
        return picture.reshape(self.size, self.size, -1)[nearest[0], nearest[1]]


def texels_of(atlas: Atlas, size: int) -> Texels:
    """The texels of S x S whose centres lie in a triangle; where triangles meet, in the first of them."""
    corners = atlas.uv.astype(np.float64)[atlas.faces] * size - 0.5
    parts = list(_inside(corners, size))
    places, triangles, weights = (np.concatenate([part[index] for part in parts]) for index in range(3))
    places, first = np.unique(places, return_index=True)
    return Texels(size, places, triangles[first], weights[first])


def _inside(
    corners: Float[np.ndarray, "F 3 2"], size: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Places, triangles and weights of the texels in each triangle, some triangles at a time.

    Args:
        corners: Column and row of each corner, in texels, where a centre has whole numbers.
        size: Width and height.
    """
    low = np.clip(np.floor(corners.min(axis=1)).astype(np.int64), 0, size - 1)
    extent = np.clip(np.ceil(corners.max(axis=1)).astype(np.int64), 0, size - 1) - low + 1
    counts = extent.prod(axis=1)
    ends = np.searchsorted(np.cumsum(counts), np.arange(_CHUNK, counts.sum() + _CHUNK, _CHUNK), side="left")
    for first, last in zip([0, *(ends[:-1] + 1)], ends + 1, strict=True):
        chosen = np.arange(first, min(last, len(counts)))
        triangles = np.repeat(chosen, counts[chosen])
        within = np.arange(len(triangles)) - np.repeat(
            np.cumsum(counts[chosen]) - counts[chosen], counts[chosen]
        )
        widths = extent[triangles, 0]
        column, row = low[triangles, 0] + within % widths, low[triangles, 1] + within // widths
        weights = _barycentric(corners[triangles], np.stack([column, row], axis=1))
        inside = (weights >= -_EDGE).all(axis=1)
        yield (row * size + column)[inside], triangles[inside], weights[inside]


def _barycentric(corners: Float[np.ndarray, "N 3 2"], points: Int[np.ndarray, "N 2"]) -> np.ndarray:
    """Weights of the corners; -1 for triangles without area, which have no inside."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    is_flat = area == 0
    safe = np.where(is_flat, 1.0, area)
    second = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / safe
    third = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / safe
    weights = np.stack([1 - second - third, second, third], axis=1)
    return np.where(is_flat[:, None], -1.0, weights)
