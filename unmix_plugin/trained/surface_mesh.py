"""The surface of a trained scene as triangles: where what its cameras see lies, trimmed to what they see.

Cameras agree on distances better than on densities: of each point of a grid the signed distance to what they see is
averaged, and the surface is where it is 0. What no camera looks into counts as solid, so that the mesh is closed and
has no inner sides; what no camera sees of it was never learnt, and is cut away unless asked for. Kept, it closes a
solid, which no camera alone looks into. Of short trainings it is several times nearer to the truth than a surface of
equal density, and much smoother, but rounds what is thinner than a pixel.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64

from unmix_plugin.errors import RunError
from unmix_plugin.trained.run_views import views_of
from unmix_plugin.trained.surface import Follow, GridPoints, SeenSurface
from unmix_plugin.trained.trained_scene import TrainedScene

_CELLS_PER_PIXEL, _CELLS = 2.0, (32, 256)
"""Cells along the edge of a pixel in the middle of the scene, and along the longest edge of the scene box."""
_REACH_PX, _REACH_CELLS = 8.0, 2.0
"""Behind what a camera sees it says nothing, the larger of the two: less leaves bubbles inside, more thickens thin
parts."""
SMOOTHING_PX = 0.75
"""Standard deviation of the blur; sharp edges get as round as this."""
_COARSER, _NEAR = 4, 0.5
"""Cells of the grid that are one of a coarse one; the part of the reach within which distances are measured finely."""
_POINTS_AT_ONCE = 1 << 20
"""Of the grid, as far as whole slices allow."""
_RINGS = 4
"""Neighbours over which normals are smoothed."""
_HEALED_RINGS = 3
"""Gaps of this many vertices between what is seen are not cut: two cameras rarely agree at an edge."""
_LARGEST_HOLE_PX = 8.0
"""Edge of a square as large as unseen parts that stay: within what is seen they are dents under highlights, mostly."""
_SMALLEST_PART, _LEAST_FACES = 0.01, 8
"""Pieces with fewer faces than this part of those of the largest, or than so many, are stray."""
_NUM_RAYS = 400_000
"""Rays that tell where the surface is."""


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles that are seen from the side on which their corners go round counter-clockwise."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def select(self, chosen: Bool[np.ndarray, " F"]) -> TriangleMesh:
        """Some of the faces, and the vertices that they have."""
        faces = self.faces[chosen]
        used, renumbered = np.unique(faces, return_inverse=True)
        return TriangleMesh(self.vertices[used], renumbered.reshape(faces.shape))

    @cached_property
    def links(self):  # noqa: ANN201 - a sparse matrix of scipy, which is imported here only
        """Symmetric matrix (V, V) that is 1 where an edge joins two vertices."""
        from scipy.sparse import coo_matrix

        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        both = np.concatenate([edges, edges[:, ::-1]])
        count = len(self.vertices)
        found = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
        found.data[:] = 1.0  # an edge counts once, however many faces have it
        return found

    def pieces(self) -> Int64[np.ndarray, " F"]:
        """Number of the piece that each face is of; vertices join faces to one."""
        from scipy.sparse.csgraph import connected_components

        return connected_components(self.links, directed=False)[1][self.faces[:, 0]].astype(np.int64)

    def smoothed(self, values: Float[np.ndarray, " V"], rings: int) -> Float64[np.ndarray, " V"]:
        """Numbers of vertices, each replaced as often as `rings` by the mean of itself and its neighbours."""
        links = self.links
        counts = 1 + np.asarray(links.sum(axis=1)).ravel()
        for _ in range(rings):
            values = (values + links @ values) / counts
        return values.astype(np.float64)

    @cached_property
    def normals(self) -> Float[np.ndarray, "V 3"]:
        """Unit normals of the vertices: means over their faces, weighted by area."""
        a, b, c = self.vertices[self.faces].swapaxes(0, 1)
        across = np.cross(b - a, c - a)
        sums = np.zeros_like(self.vertices)
        for corner in self.faces.T:
            np.add.at(sums, corner, across)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0])

    @cached_property
    def smoothed_normals(self) -> Float64[np.ndarray, "V 3"]:
        """Unit normals of the vertices, each the mean of those around it: of a surface that a short training left
        rough, they are nearer to the true ones."""
        smooth = np.stack([self.smoothed(axis, _RINGS) for axis in self.normals.T], axis=1)
        return smooth / np.linalg.norm(smooth, axis=1, keepdims=True).clip(min=1e-12)

    def areas(self) -> Float64[np.ndarray, " F"]:
        """Of the faces, as large as they are seen along the smoothed normal: rough surfaces of short trainings have
        more area than what they stand for."""
        along = self.smoothed_normals[self.faces].sum(axis=1)
        along /= np.linalg.norm(along, axis=1, keepdims=True).clip(min=1e-12)
        a, b, c = self.vertices[self.faces].swapaxes(0, 1)
        return np.maximum((np.cross(b - a, c - a) * along).sum(axis=1) / 2, 0.0)


def vertex_areas(
    areas: Float[np.ndarray, " F"], faces: Int[np.ndarray, "F 3"], count: int
) -> Float64[np.ndarray, " V"]:
    """Of each vertex, a third of the areas of its triangles."""
    return np.bincount(faces.ravel(), np.repeat(areas / 3, 3), count)


Working: TypeAlias = Callable[[str], AbstractContextManager[None]]
"""A context that shows that something of unknown length is under way."""


@torch.no_grad()
def surface_of(
    scene: TrainedScene,
    resolution: int | None = None,
    smoothing_px: float = SMOOTHING_PX,
    keeps_unseen: bool = False,
    follow: Follow = lambda _doing, items: items,
    working: Working = lambda _doing: nullcontext(),
) -> tuple[TriangleMesh, float]:
    """The surface in model space, and the part of its area that no camera sees: a guess that closes it, cut away unless
    it is kept.

    Args:
        scene: Of mixed materials.
        resolution: Cells along the longest edge of the scene box; None: two a pixel, from 32 to 256.
        smoothing_px: Standard deviation of the blur, pixels in the middle of the scene.
        keeps_unseen: Whether surfaces that no camera sees stay.
        follow, working: Show how far it is.
    Raises:
        RunError: no camera of the run sees a surface.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    seen = SeenSurface(scene, _NUM_RAYS, [view.camera for view in views_of(scene.views, "all")], follow)
    across = _CELLS_PER_PIXEL * float(scene.scene_box.size.max()) / scene.pixel_size
    grid = GridPoints.over(
        scene.scene_box.aabb, int(np.clip(round(across), *_CELLS)) if resolution is None else resolution
    )
    distances = _distances_on(grid, seen, scene, follow, is_closed=keeps_unseen)
    with working("finding the surface"):
        # Past an outline distances jump, and a blur of the whole jump would move the surface inwards.
        most = max(1.0, grid.cell / scene.pixel_size)
        distances = gaussian_filter(distances.clip(-most, most), smoothing_px * scene.pixel_size / grid.cell)
        distances = np.pad(
            distances, 1, constant_values=20 * most
        )  # the box ends what is solid, at its faces
        distances[np.abs(distances) < 1e-3] = 1e-3  # or triangles without area would tear the mesh
        if not distances.min() < 0 < distances.max():
            raise RunError("no camera of the run sees a surface: train longer, or there is nothing to export")
        places, faces, _, _ = marching_cubes(-distances, 0.0, gradient_direction="ascent")
        # The padding put the grid's first point at index 1.
        vertices = (places.astype(np.float64) - 1) * grid.cell + grid.origin
        mesh = TriangleMesh(vertices, faces.astype(np.int64))
        a, b, c = vertices[faces].swapaxes(0, 1)
        piece, volumes = mesh.pieces(), (a * np.cross(b, c)).sum(axis=1)
        is_solid = np.bincount(piece, volumes) > 0  # no hollow inside, which no light reaches
        mesh = without_stray_pieces(mesh.select(is_solid[piece]))

        is_seen = seen.shows(torch.from_numpy(mesh.vertices).float()).numpy()
        links = mesh.links
        for _ in range(_HEALED_RINGS):
            is_seen = is_seen | np.asarray(links @ is_seen.astype(np.float64) > 0)
        shown, areas = np.all(is_seen[mesh.faces], axis=1, keepdims=False), mesh.areas()
        hidden = np.flatnonzero(~shown)
        patch = TriangleMesh(mesh.vertices, mesh.faces[hidden]).pieces()
        is_hole = np.bincount(patch, areas[hidden]) < (_LARGEST_HOLE_PX * scene.pixel_size) ** 2
        piece = mesh.pieces()
        is_met = np.bincount(piece, shown) > 0  # a hole lies within what is seen
        shown[hidden] = is_hole[patch] & is_met[piece[hidden]]
        unseen = float(areas[~shown].sum() / max(areas.sum(), 1e-30))
        if not keeps_unseen:
            mesh = without_stray_pieces(mesh.select(shown))
    if len(mesh.faces) == 0:
        raise RunError(
            "nothing is left of the surface: no camera of the run sees it; keep it with --unseen keep"
        )
    return mesh, unseen


def _distances_on(
    grid: GridPoints, seen: SeenSurface, scene: TrainedScene, follow: Follow, *, is_closed: bool
) -> Float32[np.ndarray, "X Y Z"]:
    """Signed distances at the points of a grid, pixels, up to the reach: measured near the surface, elsewhere
    interpolated from a coarse grid."""
    from scipy.ndimage import affine_transform

    coarse = GridPoints.over(scene.scene_box.aabb, max(8, (max(grid.shape) - 1) // _COARSER))
    reach, wide = (max(_REACH_PX, _REACH_CELLS * one.cell / scene.pixel_size) for one in (grid, coarse))
    first = torch.cat(
        [
            seen.signed_distance(coarse.slab_points(slab).flatten(0, 2), wide, is_closed)
            for slab in coarse.slabs(_POINTS_AT_ONCE)
        ]
    )
    first, found = first.view(coarse.shape).numpy(), np.empty(grid.shape, np.float32)
    finer = grid.cell / coarse.cell
    for slab in follow("measuring distances to the surface", grid.slabs(_POINTS_AT_ONCE)):
        corner: Any = (grid.origin - coarse.origin) / coarse.cell + finer * np.array([slab.start, 0, 0])
        shape = (len(slab), *grid.shape[1:])
        parts = affine_transform(first, np.full(3, finer), corner, shape, order=1, mode="nearest")
        near = np.abs(parts) < _NEAR
        parts = (parts * (wide / reach)).clip(-1, 1)
        points = grid.points_at(np.argwhere(near) + np.array([slab.start, 0, 0]))
        parts[near] = seen.signed_distance(points, reach, is_closed).numpy()
        found[slab.start : slab.stop] = reach * parts
    return found


def without_stray_pieces(mesh: TriangleMesh) -> TriangleMesh:
    """The pieces of a mesh that have a hundredth of the faces of the largest or more."""
    piece = mesh.pieces()
    sizes = np.bincount(piece, minlength=1)
    smallest = max(_SMALLEST_PART * float(sizes.max()), min(_LEAST_FACES, int(sizes.max())))
    return mesh.select(np.asarray(sizes[piece] >= smallest))
