"""The surface of a trained scene as one closed mesh, for what has to know where light can't pass.

Cameras agree on distances better than on densities: of each point of a grid the signed distance to what they see is
averaged, and the surface is where it is 0. What no camera looks into counts as solid, so that the mesh has no holes;
how much of it is closed that way is said. Of short trainings it is several times nearer to the truth than a surface of
equal density, and much smoother, but rounds what is thinner than a pixel.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64

from unmix_plugin.errors import RunError
from unmix_plugin.trained.decimation import decimated
from unmix_plugin.trained.run_views import views_of
from unmix_plugin.trained.surface import Follow, GridPoints, SeenSurface
from unmix_plugin.trained.surface_mesh import TriangleMesh, Working
from unmix_plugin.trained.trained_scene import TrainedScene

_CELLS_A_PIXEL, _CELLS = 2.0, (32, 224)
"""Cells along the edge of a pixel in the middle of the scene, and along the longest edge of the scene box."""
_REACH_PX = 8.0
"""Behind what a camera sees it says nothing: less leaves bubbles inside, more thickens thin parts."""
_BLUR_PX = 0.75
"""Standard deviation; sharp edges get as round as this."""
_NUM_RAYS = 400_000
_COARSER, _NEAR = 4, 0.5
"""Cells of the grid that are one of a coarse one; the part of the reach within which distances are measured finely."""
_SMALLEST_PIECE = 0.005
"""Pieces of less volume, as a part of that of the largest, are stray."""


@dataclass(frozen=True)
class ClosedSurface:
    """A mesh without holes, model space."""

    mesh: TriangleMesh
    unseen: float
    """Part of its area that no camera sees: there it is a guess."""
    num_found: int
    """Triangles before it was decimated."""


@torch.no_grad()
def closed_surface(
    scene: TrainedScene,
    num_faces: int,
    follow: Follow = lambda _doing, items: items,
    working: Working = lambda _doing: nullcontext(),
) -> ClosedSurface:
    """The surface that the run's cameras see, closed, with at most about so many triangles.

    Args:
        scene: Of mixed materials.
        num_faces: To which the mesh is decimated.
        follow, working: Show how far it is.
    Raises:
        RunError: no camera of the run sees a surface.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    cameras = [view.camera for view in views_of(scene.views, "all")]
    seen = SeenSurface(scene, _NUM_RAYS, cameras, follow)
    cells_across = _CELLS_A_PIXEL * float(scene.scene_box.size.max()) / scene.pixel_size
    cells = int(np.clip(round(cells_across), *_CELLS))
    grid = GridPoints.over(scene.scene_box.aabb, cells)
    coarse = GridPoints.over(scene.scene_box.aabb, max(8, cells // _COARSER))
    first = np.stack([_distances(seen, coarse.slice_points(index)) for index in range(coarse.shape[0])])
    slices = follow("measuring distances to the surface", range(grid.shape[0]))
    parts = [_refined(seen, grid.slice_points(index), coarse, first) for index in slices]
    with working("closing the surface"):
        distances = gaussian_filter(np.stack(parts), _BLUR_PX * scene.pixel_size / grid.cell)
        distances = np.pad(distances, 1, constant_values=1.0)  # the box ends what is solid
        distances[np.abs(distances) < 1e-4] = 1e-4  # or triangles without area would tear the mesh
        if not distances.min() < 0 < distances.max():
            raise RunError("no camera of the run sees a surface: train longer, or there is nothing to export")
        places, faces, _, _ = marching_cubes(-distances, 0.0, gradient_direction="ascent")
        vertices = (places.astype(np.float64) - 1) * grid.cell + grid.origin
        whole = _without_bubbles(TriangleMesh(vertices, faces.astype(np.int64)))
        mesh = decimated(whole, num_faces)
    is_seen = seen.shows(torch.from_numpy(mesh.vertices).float()).numpy()
    areas = mesh.areas()
    unseen = float(areas[~is_seen[mesh.faces].any(axis=1)].sum() / areas.sum())
    return ClosedSurface(mesh, unseen, len(whole.faces))


def _distances(seen: SeenSurface, points: Float[torch.Tensor, "Y Z 3"]) -> Float32[np.ndarray, "Y Z"]:
    return seen.signed_distance(points.flatten(0, 1), _REACH_PX).view(points.shape[:2]).numpy()


def _refined(
    seen: SeenSurface,
    points: Float[torch.Tensor, "Y Z 3"],
    coarse: GridPoints,
    first: Float32[np.ndarray, "a b c"],
) -> Float32[np.ndarray, "Y Z"]:
    """Distances at points: measured near the surface, elsewhere interpolated from a coarse grid."""
    from scipy.ndimage import map_coordinates

    flat = points.flatten(0, 1)
    places = (flat.numpy() - coarse.origin) / coarse.cell
    found = map_coordinates(first, places.T, order=1, mode="nearest")
    near = torch.from_numpy(np.abs(found) < _NEAR)
    found[near.numpy()] = seen.signed_distance(flat[near], _REACH_PX).numpy()
    return found.reshape(points.shape[:2])


def _without_bubbles(mesh: TriangleMesh) -> TriangleMesh:
    """The pieces of a closed mesh that hold something: neither hollows inside, which no light reaches, nor specks."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count, ends = len(mesh.vertices), mesh.faces[:, [0, 1]]
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    of_vertices = connected_components(links, directed=False)[1]
    piece = of_vertices[mesh.faces[:, 0]]
    volumes: Float64[np.ndarray, " n"] = np.bincount(piece, _signed_volumes(mesh))
    is_solid: Bool[np.ndarray, " n"] = volumes > _SMALLEST_PIECE * volumes.max()
    return mesh.select(is_solid[piece])


def _signed_volumes(mesh: TriangleMesh) -> Float64[np.ndarray, " F"]:
    """Of the tetrahedra from the origin to each face; their sum is the volume inside."""
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    return (a * np.cross(b, c)).sum(axis=1) / 6
