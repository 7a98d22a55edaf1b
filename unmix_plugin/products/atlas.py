"""Texture coordinates of a mesh, and the place on it that every texel shows.

A mesh is cut into charts, connected triangles that face about the same way, each seen flat along an axis; xatlas packs
them side by side into the unit square. Cutting by direction takes time proportional to the triangles and can't fail; no
length in a chart shrinks below half.

Notation: `V` vertices of the mesh, `U` of the cut one (a vertex on a seam is there once a chart), `F` triangles, `S x
S` texels, `T` of them in charts. Texel (row, column) has its centre at u = (column + 0.5) / S,
v = (row + 0.5) / S.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, Int64, Shaped

from unmix_plugin.errors import ConfigError

_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_ROUNDS = 6
"""Rounds in which directions are averaged with those of neighbours, and small charts join others."""

_LEAST_COSINE = 0.3
"""Of a triangle's normal with the axis of a chart that it may join."""

_SMALL = 24
"""Triangles of a chart that had better join another one."""
_PADDING = 4
"""Texels between charts, so that linear interpolation and two levels of smaller copies don't mix them."""
_TRIES = 6
_CHUNK = 1 << 21
"""Texels of bounding boxes that are looked at together."""
_EDGE = 1e-6
"""Barycentric weight down to which a texel on an edge counts as inside."""


def _chart_labels(
    positions: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The chart of each triangle, counted from 0, and the axis (0 to 5) that each triangle is seen along."""
    a, b, c = positions[faces].swapaxes(0, 1)
    across, links = np.cross(b - a, c - a), _links(faces)
    normals = across / np.linalg.norm(across, axis=1, keepdims=True).clip(1e-30)
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


def _best(scores: np.ndarray, normals: np.ndarray, otherwise: np.ndarray | None = None) -> np.ndarray:
    """The axis of the highest score among those that a triangle faces; the nearest one where there is none."""
    cosines = normals @ _AXES.T
    allowed = (cosines > _LEAST_COSINE) & ((scores > 0) if otherwise is not None else True)
    chosen = np.where(allowed, scores, -np.inf).argmax(axis=1)
    return np.where(allowed.any(axis=1), chosen, cosines.argmax(axis=1) if otherwise is None else otherwise)


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


@dataclass(frozen=True)
class Atlas:
    """A mesh cut open."""

    vertices: Int64[np.ndarray, " U"]
    """The vertex of the mesh that each vertex is a copy of."""
    faces: Int64[np.ndarray, "F 3"]
    """Vertices of each triangle, in the mesh's order of triangles."""
    uv: Float32[np.ndarray, "U 2"]
    """Texture coordinates as glTF has them: u to the right, v downwards, [0, 1]."""


def unwrap(positions: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], texture_size: int) -> Atlas:
    """Cut a mesh into charts and pack them into textures so many texels wide and high.

    Raises:
        ConfigError: xatlas is not installed, or the charts don't fit into a texture of this size.
    Source:
        Packing by xatlas (Young).
    """
    if importlib.util.find_spec("xatlas") is None:
        raise ConfigError(
            "texture coordinates need the package xatlas, which is not installed (Python 3.14 has no wheel of it, so "
            "that a C++ compiler is needed): python -m pip install xatlas"
        )
    faces = faces.astype(np.int64)
    charts, axes = _chart_labels(positions, faces)
    # A vertex is there once for each chart that it has a part in.
    keys, corners = np.unique(charts[:, None].astype(np.int64) * len(positions) + faces, return_inverse=True)
    cut, vertices = corners.reshape(faces.shape), keys % len(positions)
    axis_of_chart = np.zeros(charts.max() + 1, dtype=np.int64)
    axis_of_chart[charts] = axes
    # Points as they are seen along their chart's axis, not mirrored.
    right = np.roll(np.abs(_AXES), 1, axis=1)
    up, chart_axes = np.cross(_AXES, right), axis_of_chart[keys // len(positions)]
    flat = np.stack([(positions[vertices] * side[chart_axes]).sum(axis=1) for side in (right, up)], axis=1)
    # Triangles of less than about 1e-7 units of area would not be placed.
    flat = (flat / np.linalg.norm(np.diff(flat[cut[:, :2]], axis=1), axis=2).mean()).astype(np.float32)
    packer = _packed(flat, cut, charts, texture_size)
    order, packed, uv = packer[0]
    return Atlas(vertices[order.astype(np.int64)], packed.astype(np.int64), uv.astype(np.float32))


def _packed(flat: np.ndarray, cut: np.ndarray, charts: np.ndarray, texture_size: int) -> Any:
    """The packed charts; xatlas only estimates how large they may be, so that what it finds is scaled to fit."""
    import xatlas

    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = texture_size, _PADDING, True
    for _ in range(_TRIES):
        packer = xatlas.Atlas()
        packer.add_uv_mesh(flat, cut.astype(np.uint32), charts[:, None].astype(np.uint32))
        packer.generate(xatlas.ChartOptions(), packing)
        side = max(packer.width, packer.height)
        if packer.atlas_count == 1 and side <= texture_size:
            return packer
        packing.resolution = 0
        packing.texels_per_unit = 0.98 * packer.texels_per_unit * texture_size / side
    raise ConfigError(
        f"the {charts.max() + 1} charts of {len(cut)} triangles don't fit into a texture of {texture_size} x "
        f"{texture_size}; choose a larger --texture-size or simplify the mesh"
    )


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

    def texture(self, values: Shaped[np.ndarray, "T C"]) -> np.ndarray:
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
    """Places, triangles and weights of the texels in each triangle, some triangles at a time; the corners are column
    and row in texels, where a centre has whole numbers."""
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
