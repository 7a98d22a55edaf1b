"""The surface of a trained scene as triangles: marching cubes through the density, trimmed to what cameras see.

The surface is where the density is that rays end at, softened a little since the field is trained on images and not
on surfaces. What no camera sees (insides, undersides) was never learnt: it is taken for solid and its surfaces are cut
away unless asked for, and so are stray pieces.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int

from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.run_views import views_of
from unmix_plugin.trained.surface import Follow, GridPoints, SeenSurface, SurfacePoints, look_at, sample_field
from unmix_plugin.trained.trained_scene import TrainedScene

_END_QUANTILE = 0.07
"""Rays end inside what they hit: this part of them where the density is still lower than at the surface."""
_MOST_MOVED = 3.0
"""Pixels that a vertex is moved at most: deeper, a ray from above went through a hole."""
_RINGS, _AREA_RINGS = 3, 4
"""Neighbours over which the way that vertices are moved, and normals along which areas are taken, are smoothed."""
_HEALED_RINGS = 3
"""Gaps of this many vertices between what is seen are not cut: two cameras rarely agree at an edge."""
_SMALLEST_PART, _LEAST_FACES = 0.01, 8
"""Pieces with fewer faces than this part of those of the largest, or than so many, are stray."""
_NUM_RAYS = 300_000
"""Rays that tell what of the surface is seen."""


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

    def smoothed(self, values: Float[np.ndarray, " V"], rings: int) -> Float64[np.ndarray, " V"]:
        """Numbers of vertices, each replaced as often as `rings` by the mean of itself and its neighbours."""
        links = _links(self)
        links.data[:] = 1.0  # an edge counts once, however many faces have it
        counts = 1 + np.asarray(links.sum(axis=1)).ravel()
        for _ in range(rings):
            values = (values + links @ values) / counts
        return values.astype(np.float64)

    @property
    def normals(self) -> Float[np.ndarray, "V 3"]:
        """Unit normals of the vertices: means over their faces, weighted by area."""
        a, b, c = self.vertices[self.faces].swapaxes(0, 1)
        across = np.cross(b - a, c - a)
        sums = np.zeros_like(self.vertices)
        for corner in self.faces.T:
            np.add.at(sums, corner, across)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0])

    def areas(self) -> Float64[np.ndarray, " F"]:
        """Of the faces, as large as they are seen along the smoothed normal: rough surfaces of short trainings have
        more area than what they stand for."""
        smooth = np.stack([self.smoothed(axis, _AREA_RINGS) for axis in self.normals.T], axis=1)
        along = smooth[self.faces].sum(axis=1)
        along /= np.linalg.norm(along, axis=1, keepdims=True).clip(min=1e-12)
        a, b, c = self.vertices[self.faces].swapaxes(0, 1)
        return np.maximum((np.cross(b - a, c - a) * along).sum(axis=1) / 2, 0.0)


def vertex_areas(
    areas: Float[np.ndarray, " F"], faces: Int[np.ndarray, "F 3"], count: int
) -> Float64[np.ndarray, " V"]:
    """Of each vertex, a third of the areas of its triangles."""
    return np.bincount(faces.ravel(), np.repeat(areas / 3, 3), count)


def _surface_density(scene: TrainedScene, ends: SurfacePoints) -> float:
    """Density per model unit at which the surface lies, from the densities where rays end."""
    densities, _ = sample_field(scene, ends.positions, with_abundances=False)
    densities = densities[densities > 0]
    if len(densities) == 0:
        raise RunError(
            "no ray of the run's cameras ends on a surface: train longer, or there is nothing to export"
        )
    return float(np.quantile(densities.double().numpy(), _END_QUANTILE))


def _extract_mesh(
    densities: Float32[np.ndarray, "X Y Z"],
    grid: GridPoints,
    threshold: float,
    softness: float,
    pixel_size: float,
) -> TriangleMesh:
    """Marching cubes where the density passes a threshold.

    The cubes (Lewiner et al. 2003, as in scikit-image) go through the opacity of a pixel's length rather than the
    density itself, which differs by many orders of magnitude between neighbours.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    opacities = np.pad(-np.expm1(-densities.astype(np.float64) * pixel_size), 1)
    if softness > 0:
        opacities = gaussian_filter(opacities, softness, mode="constant")
    level = -math.expm1(-threshold * pixel_size)
    if not opacities.min() < level < opacities.max():
        raise ConfigError(
            f"no surface: the greatest density on the grid is {densities.max() / threshold:.3g} times "
            "the density asked for; choose a lower --density or a finer --resolution"
        )
    vertices, faces, _, _ = marching_cubes(opacities, level, gradient_direction="ascent")
    # The padding put the grid's first point at index 1.
    return TriangleMesh((vertices.astype(np.float64) - 1) * grid.cell + grid.origin, faces.astype(np.int64))


def _filled(
    densities: Float32[np.ndarray, "X Y Z"], grid: GridPoints, scene: TrainedScene, surface: SeenSurface
) -> Float32[np.ndarray, "X Y Z"]:
    """Densities with what no camera sees into as solid as the densest point, so that surfaces have no inner side."""
    result, solid = densities.copy(), densities.max()
    for index in range(len(result)):
        points = grid.slice_points(index)
        unknown = torch.from_numpy(result[index] == 0)
        # Not in the space that was found to be empty before training.
        unknown[unknown.clone()] = scene.renderer.is_reachable(points[unknown].to(scene.device)).cpu()
        unknown[unknown.clone()] = surface.hides(points[unknown])
        result[index][unknown.numpy()] = solid
    return result


def _trim_unseen(mesh: TriangleMesh, surface: SeenSurface) -> TriangleMesh:
    """The parts of a mesh that the cameras see, with small gaps left whole."""
    seen = surface.shows(torch.from_numpy(mesh.vertices).float()).numpy()
    links = _links(mesh)
    for _ in range(_HEALED_RINGS):
        seen = seen | np.asarray(links @ seen.astype(np.float64) > 0)
    return mesh.select(np.all(seen[mesh.faces], axis=1, keepdims=False))


def _without_stray_pieces(mesh: TriangleMesh) -> TriangleMesh:
    """The pieces of a mesh, each joined by common edges, that have a hundredth of the faces of the largest or more."""
    if len(mesh.faces) == 0:
        return mesh
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.faces)
    ends = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, edges = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1], return_inverse=True)
    # Each face is joined to its edges, which are numbered after the faces.
    sides = (np.ones(len(edges)), (np.repeat(np.arange(count), 3), count + edges))
    size = count + int(edges.max()) + 1
    _, piece = connected_components(coo_matrix(sides, shape=(size, size)), directed=False)
    sizes = np.bincount(piece[:count])
    smallest = max(_SMALLEST_PART * float(sizes.max()), min(_LEAST_FACES, sizes.max()))
    return mesh.select(np.asarray(sizes[piece[:count]] >= smallest))


def _links(mesh: TriangleMesh):  # noqa: ANN202 - a sparse matrix of scipy, which is imported here only
    """Symmetric matrix (V, V) that is not 0 where an edge joins two vertices."""
    from scipy.sparse import coo_matrix

    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    both = np.concatenate([edges, edges[:, ::-1]])
    count = len(mesh.vertices)
    return coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()


@torch.no_grad()
def _where_rays_end(scene: TrainedScene, mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with its vertices moved along their normals to where rays from above end on average.

    A surface of equal density lies up to a pixel before that, and seen aslant what is on it would be beside its place.
    """
    normals = mesh.normals
    positions, along = (torch.from_numpy(values).float() for values in (mesh.vertices, -normals))
    found = look_at(scene, positions, along)
    depths = (found.ray_distance - scene.pixel_size) * (found.accumulation > OCCUPIED_ACCUMULATION)
    most = _MOST_MOVED * scene.pixel_size
    moved = mesh.smoothed(depths.clamp(-most, most).double().cpu().numpy(), _RINGS)
    return TriangleMesh(mesh.vertices - moved[:, None] * normals, mesh.faces)


Working: TypeAlias = Callable[[str], AbstractContextManager[None]]
"""A context that shows that something of unknown length is under way."""


def surface_of(
    scene: TrainedScene,
    resolution: int,
    density: float | None = None,
    smoothing: float = 1.0,
    keeps_unseen: bool = False,
    follow: Follow = lambda _doing, items: items,
    working: Working = lambda _doing: nullcontext(),
) -> tuple[TriangleMesh, float]:
    """The surface in model space, and the density per model unit at which it lies.

    Args:
        scene: Of mixed materials.
        resolution: Cells along the longest edge of the scene box.
        density: Per world unit at which the surface lies; None: that at which rays end.
        smoothing: Standard deviation of the blur, cells.
        keeps_unseen: Whether surfaces that no camera sees stay.
        follow, working: Show how far it is.
    Raises:
        ConfigError: nothing is as dense as was asked for.
        RunError: no camera of the run sees a surface.
    """
    cameras = [view.camera for view in views_of(scene.views, "all")]
    surface = SeenSurface(scene, _NUM_RAYS, cameras, follow)
    grid = GridPoints.over(scene.scene_box.aabb, resolution)
    slices = follow("sampling the density", range(grid.shape[0]))
    parts = (grid.slice_points(index) for index in slices)
    densities = np.stack([sample_field(scene, part, with_abundances=False)[0].numpy() for part in parts])
    with working("finding the surface"):
        found = _surface_density(scene, surface.points()) if density is None else density / scene.frame.scale
        solid = densities if keeps_unseen else _filled(densities, grid, scene, surface)
        mesh = _extract_mesh(solid, grid, found, smoothing, scene.pixel_size)
        if density is None:
            mesh = _where_rays_end(scene, mesh)
        mesh = _without_stray_pieces(mesh if keeps_unseen else _trim_unseen(mesh, surface))
    if len(mesh.faces) == 0:
        raise RunError(
            "nothing is left of the surface: no camera of the run sees it; keep it with --unseen keep"
        )
    return mesh, found
