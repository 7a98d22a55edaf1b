"""Meshes of fewer triangles: edges whose collapse changes the surface least are collapsed first.

Each vertex keeps the squared distances to the planes of all triangles that were merged into it, as a quadric; an edge
goes to the point where the sum of its vertices' quadrics is least. Edges are collapsed in rounds, in each those that
are the cheapest in their neighbourhood, which do not touch each other: a round is then a few operations on arrays.

Notation: `V` vertices, `F` faces, `E` edges.

Source: Garland and Heckbert 1997, Surface Simplification Using Quadric Error Metrics; Dey et al. 1999, Topology
Preserving Edge Contraction, for the link condition.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64

from unmix_plugin.trained.surface_mesh import TriangleMesh

_BOUNDARY_WEIGHT = 10.0
"""Of planes upright on the boundary of an open mesh, which would shrink otherwise."""
_LEAST_COSINE = 0.3
"""Between the normals of a triangle before and after a collapse."""
_CHEAPEST = 0.5
"""Part of the edges that a round looks at: dearer ones wait until cheaper ones are gone."""
_MIDDLE = 1e-3
"""Pull towards the middle of an edge, as a part of the quadric: in planes all places are as good."""
_MOST_ROUNDS = 400


def decimated(mesh: TriangleMesh, num_faces: int) -> TriangleMesh:
    """The mesh with at most so many triangles, or as few as can be without changing how its parts are joined.

    What was closed stays closed, and no triangle turns round. Vertices of no triangle are left out.
    """
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    quadrics, refused = _quadrics(vertices, faces), np.zeros(0, np.int64)
    for _ in range(_MOST_ROUNDS):
        if len(faces) <= num_faces:
            break
        edges, counts = _edges(faces)
        kept = _is_collapsible(faces, edges, counts, len(vertices))
        kept &= ~np.isin(edges[:, 0] * len(vertices) + edges[:, 1], refused)
        edges, counts = edges[kept], counts[kept]
        if not len(edges):
            break
        places, costs = _best_places(vertices, quadrics, edges)
        chosen = _independent(edges, costs, faces, len(vertices))
        needed = int(np.searchsorted(np.cumsum(counts[chosen]), len(faces) - num_faces)) + 1
        chosen = chosen[:needed]
        pairs = edges[chosen]
        sound = _keeps_normals(vertices, faces, pairs, places[chosen])
        refused = np.append(refused, pairs[~sound, 0] * len(vertices) + pairs[~sound, 1])
        (kept_vertices, gone), there = pairs[sound].T, places[chosen][sound]
        vertices[kept_vertices] = there
        quadrics[kept_vertices] += quadrics[gone]
        renamed = np.arange(len(vertices))
        renamed[gone] = kept_vertices
        faces = renamed[faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
    used, numbers = np.unique(faces, return_inverse=True)
    return TriangleMesh(vertices[used], numbers.reshape(faces.shape))


def _edges(faces: Int[np.ndarray, "F 3"]) -> tuple[Int64[np.ndarray, "E 2"], Int64[np.ndarray, " E"]]:
    """Pairs of vertices, the lower number first, and how many triangles each joins."""
    a, b, c = faces.T
    count = int(faces.max()) + 1
    pairs = np.concatenate([np.minimum(s, e) * count + np.maximum(s, e) for s, e in ((a, b), (b, c), (c, a))])
    numbers, counts = np.unique(pairs, return_counts=True)
    return np.stack(np.divmod(numbers, count), axis=1), counts


def _quadrics(
    vertices: Float64[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float64[np.ndarray, "V 4 4"]:
    """Of each vertex: sums over its triangles' planes `n x + d = 0` of (n, d) (n, d)^T, weighted by area."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    across = np.cross(b - a, c - a)
    doubled = np.linalg.norm(across, axis=1)
    normals = across / doubled[:, None].clip(min=1e-30)
    found = np.zeros((len(vertices), 4, 4))

    def add(corners: np.ndarray, normals: np.ndarray, on: np.ndarray, weights: np.ndarray) -> None:
        planes = np.column_stack([normals, -(normals * on).sum(axis=1)])
        products = weights[:, None, None] * planes[:, :, None] * planes[:, None, :]
        for corner in corners.T:
            np.add.at(found, corner, products)

    add(faces, normals, a, doubled)
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, counts = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    open_sides = first[counts == 1]
    start, end = vertices[sides[open_sides]].swapaxes(0, 1)
    upright = np.cross(end - start, normals[open_sides % len(faces)])
    squared = (upright**2).sum(axis=1)
    upright /= np.sqrt(squared)[:, None].clip(min=1e-30)
    add(sides[open_sides], upright, start, _BOUNDARY_WEIGHT * squared)
    return found


def _is_collapsible(
    faces: Int[np.ndarray, "F 3"],
    edges: Int64[np.ndarray, "E 2"],
    counts: Int64[np.ndarray, " E"],
    num_vertices: int,
) -> Bool[np.ndarray, " E"]:
    """Whether a collapse leaves the mesh joined as it is: the ends of an edge have no common neighbours but the third
    corners of its triangles, and no edge within the mesh joins two places of its boundary."""
    from scipy.sparse import coo_matrix

    ones = np.ones(2 * len(edges))
    both = np.concatenate([edges, edges[:, ::-1]])
    links = coo_matrix((ones, (both[:, 0], both[:, 1])), shape=(num_vertices, num_vertices)).tocsr()
    common = np.asarray(links[edges[:, 0]].multiply(links[edges[:, 1]]).sum(axis=1)).ravel()
    is_outer = np.zeros(num_vertices, dtype=bool)
    is_outer[edges[counts == 1]] = True
    bridges = (counts > 1) & is_outer[edges].all(axis=1)
    return (common == counts) & (counts <= 2) & ~bridges & (len(faces) > 4)


def _best_places(
    vertices: Float64[np.ndarray, "V 3"],
    quadrics: Float64[np.ndarray, "V 4 4"],
    edges: Int64[np.ndarray, "E 2"],
) -> tuple[Float64[np.ndarray, "E 3"], Float64[np.ndarray, " E"]]:
    """Where the ends of each edge meet best, and what that costs: the sum of squared distances, weighted by area."""
    sums, ends = quadrics[edges[:, 0]] + quadrics[edges[:, 1]], vertices[edges]
    middle = ends.mean(axis=1)
    matrix = sums[:, :3, :3]
    pull = _MIDDLE * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-30 * np.eye(3)
    offset = -sums[:, :3, 3] - np.einsum("eij,ej->ei", matrix, middle)
    places = middle + np.linalg.solve(matrix + pull, offset[..., None])[..., 0]
    full = np.column_stack([places, np.ones(len(places))])
    costs = np.einsum("ei,eij,ej->e", full, sums, full)
    # Of edges that cost the same, as in planes, the shortest first.
    lengths = ((ends[:, 0] - ends[:, 1]) ** 2).sum(axis=1)
    return places, costs + 1e-6 * np.trace(matrix, axis1=1, axis2=2) * lengths


def _independent(
    edges: Int64[np.ndarray, "E 2"],
    costs: Float64[np.ndarray, " E"],
    faces: Int[np.ndarray, "F 3"],
    num_vertices: int,
) -> Int64[np.ndarray, " n"]:
    """Edges that are the cheapest of all within two edges of their ends, the cheapest first; no triangle touches two of
    them."""
    order = np.argsort(costs, kind="stable")
    order = order[: max(1, int(_CHEAPEST * len(order)))]
    ranks = np.full(len(edges), len(edges))
    ranks[order] = np.arange(len(order))
    nearest = np.full(num_vertices, len(edges))
    for end in edges.T:
        np.minimum.at(nearest, end, ranks)
    around, least = nearest.copy(), nearest[faces].min(axis=1)
    for corner in faces.T:
        np.minimum.at(around, corner, least)
    is_least = (ranks == around[edges[:, 0]]) & (ranks == around[edges[:, 1]]) & (ranks < len(edges))
    chosen = is_least.nonzero()[0]
    return chosen[np.argsort(ranks[chosen])]


def _keeps_normals(
    vertices: Float64[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    pairs: Int64[np.ndarray, "E 2"],
    places: Float64[np.ndarray, "E 3"],
) -> Bool[np.ndarray, " E"]:
    """Whether no triangle that stays turns by much when edges collapse to places, edge by edge."""
    moved, of_edge = vertices.copy(), np.full(len(vertices), -1)
    for end in pairs.T:
        moved[end], of_edge[end] = places, np.arange(len(pairs))
    edges = of_edge[faces]
    is_touched = (edges >= 0).sum(axis=1) == 1  # those with two such corners vanish
    touched, edge = faces[is_touched], edges[is_touched].max(axis=1)
    before, after = (_areas(points[touched]) for points in (vertices, moved))
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    turns = (before * after).sum(axis=1) < _LEAST_COSINE * lengths
    sound = np.ones(len(pairs), dtype=bool)
    sound[edge[turns | (lengths == 0)]] = False
    return sound


def _areas(corners: Float[np.ndarray, "F 3 3"]) -> Float64[np.ndarray, "F 3"]:
    a, b, c = corners.swapaxes(0, 1)
    return np.cross(b - a, c - a)
