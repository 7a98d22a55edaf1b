"""The scene's surface as a mesh: marching cubes through the density, trimmed to what the run's cameras see.

The surface is where the density is that rays end at, softened a little since the field is trained on images and not
on surfaces. What no camera sees (insides, undersides) was never learnt: it is taken for solid and its surfaces are cut
away unless asked for, and so are crumbs.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int

from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.formats.glb import write_glb
from unmix_plugin.formats.obj import obj_paths, write_obj
from unmix_plugin.formats.ply import write_ply
from unmix_plugin.model import UnmixModel
from unmix_plugin.products.product_formats import MeshFormat
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.density_grid import GridPoints, may_hold_matter, sample_densities
from unmix_plugin.trained.surface import SeenSurface, SurfacePoints, look_from_above
from unmix_plugin.trained.surface_appearance import SurfaceLooks
from unmix_plugin.trained.world_frame import directions_to_world

_END_QUANTILE = 0.07
"""Rays end within the matter they end on: this part of them where the density is still lower than the surface's."""

_MOST_SMOOTHING = 8.0

_HEALED_RINGS = 3
"""Gaps of this many vertices between what is seen are not cut: two cameras rarely agree at an edge."""

_SMALLEST_PART = 0.01
"""Parts with fewer vertices than this, relative to the largest, are crumbs."""


@dataclass(frozen=True)
class Mesh:
    """Triangles that are seen from the side on which their corners go round counter-clockwise."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def select(self, chosen: Bool[np.ndarray, " F"]) -> Mesh:
        """Some of the faces, and the vertices that they have."""
        faces = self.faces[chosen]
        used, renumbered = np.unique(faces, return_inverse=True)
        return Mesh(self.vertices[used], renumbered.reshape(faces.shape))

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


def mesh_paths(folder: Path, formats: tuple[MeshFormat, ...]) -> list[Path]:
    """Files that `write_mesh` makes."""
    return [path for kind in formats for path in _paths(folder, kind)]


def require_sound(density: float | None, smoothing: float) -> None:
    """Refuse impossible settings.

    Raises:
        ConfigError: a density that is not positive, or a smoothing that is negative or wider than what it smooths.
    """
    if density is not None and not 0 < density < math.inf:
        raise ConfigError(f"--density is {density:g}; it must be greater than 0")
    if not 0 <= smoothing <= _MOST_SMOOTHING:
        raise ConfigError(f"--smoothing is {smoothing:g}; choose 0 to {_MOST_SMOOTHING:g} cells")


def surface_density(model: UnmixModel, ends: SurfacePoints) -> float:
    """Density per model unit at which the surface lies, from the densities where rays end.

    Raises:
        RunError: no ray ends anywhere.
    """
    densities = sample_densities(model, ends.positions)
    densities = densities[densities > 0]
    if len(densities) == 0:
        raise RunError(
            "no ray of the run's cameras ends on a surface: train longer, or there is nothing to export"
        )
    return float(np.quantile(densities.double().numpy(), _END_QUANTILE))


def extract_mesh(
    densities: Float32[np.ndarray, "X Y Z"],
    grid: GridPoints,
    threshold: float,
    softness: float,
    pixel_size: float,
) -> Mesh:
    """Marching cubes where the density passes a threshold.

    The cubes go through the opacity of a pixel's length rather than the density itself, which differs by many orders
    of magnitude between neighbours.

    Args:
        densities: At the grid's points, per model unit.
        grid: Of the densities, model space.
        threshold: Density of the surface, > 0.
        softness: Standard deviation in cells of the blur that goes before; 0 for none.
        pixel_size: Edge of a pixel in the middle of the scene, model units.
    Raises:
        ConfigError: no density passes the threshold.
    Source:
        Lewiner et al. 2003, as in scikit-image.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    opacities = np.pad(-np.expm1(-densities.astype(np.float64) * pixel_size), 1)
    if softness > 0:
        opacities = gaussian_filter(opacities, softness, mode="constant")
    level = -math.expm1(-threshold * pixel_size)
    if not opacities.min() < level < opacities.max():
        raise ConfigError(
            f"no surface at a density of {threshold:g} per model unit, the greatest on the grid being "
            f"{densities.max():g}; choose a lower --density or a finer --resolution"
        )
    vertices, faces, _, _ = marching_cubes(opacities, level, gradient_direction="ascent")
    # The padding put the grid's first point at index 1.
    return Mesh((vertices.astype(np.float64) - 1) * grid.cell + grid.origin, faces.astype(np.int64))


def filled(
    densities: Float32[np.ndarray, "X Y Z"], grid: GridPoints, model: UnmixModel, surface: SeenSurface
) -> Float32[np.ndarray, "X Y Z"]:
    """Densities with what no camera sees into as solid as the densest point, so that surfaces have no inner side.

    Args:
        densities: At the grid's points, 0 where nothing is rendered.
        grid: Of the densities, model space.
        surface: What the cameras see.
    """
    result, solid = densities.copy(), densities.max()
    for index in range(len(result)):
        points = grid.slice_points(index)
        unknown = torch.from_numpy(result[index] == 0)
        unknown[unknown.clone()] = may_hold_matter(model, points[unknown].to(model.device)).cpu()
        unknown[unknown.clone()] = surface.hides(points[unknown])
        result[index][unknown.numpy()] = solid
    return result


def trim_unseen(mesh: Mesh, surface: SeenSurface) -> Mesh:
    """The parts of a mesh that the cameras see, with small gaps left whole."""
    seen = surface.shows(torch.from_numpy(mesh.vertices).float()).numpy()
    links = _links(mesh)
    for _ in range(_HEALED_RINGS):
        seen = seen | np.asarray(links @ seen.astype(np.float64) > 0)
    return mesh.select(np.all(seen[mesh.faces], axis=1, keepdims=False))


def without_crumbs(mesh: Mesh) -> Mesh:
    """The parts of a mesh that have at least a hundredth of the vertices of the largest."""
    if len(mesh.faces) == 0:
        return mesh
    from scipy.sparse.csgraph import connected_components

    _, part = connected_components(_links(mesh), directed=False)
    sizes = np.bincount(part)
    smallest = _SMALLEST_PART * float(sizes.max())
    return mesh.select(np.asarray(sizes[part[mesh.faces[:, 0]]] >= smallest))


def write_mesh(
    folder: Path, formats: tuple[MeshFormat, ...], mesh: Mesh, model: UnmixModel, frame: Normalisation
) -> list[Path]:
    """Write a mesh with the colour, material and abundances of each vertex, seen from straight above it.

    PLY carries all of it; glTF positions, normals, colours (linear), `_MATERIAL` and abundances; OBJ positions,
    normals, colours (sRGB) and the material of each face.

    Args:
        folder: Where to write; it is made.
        formats: Which.
        mesh: Model space.
        model: Trained.
        frame: Of the run; files are in world coordinates.
    Raises:
        RunError: there is no face, or the disk is full or refuses.
    """
    if len(mesh.faces) == 0:
        raise RunError(
            "nothing is left of the surface: no camera of the run sees it; keep it with --unseen keep"
        )
    normals = mesh.normals
    positions = torch.from_numpy(mesh.vertices).float()
    seen = look_from_above(model, positions, torch.from_numpy(normals).float())
    looks = SurfaceLooks(model.materials, *seen)
    world = Mesh(frame.to_world(mesh.vertices).astype(np.float32), mesh.faces)
    turned = directions_to_world(frame, normals).astype(np.float32)
    writers = {"ply": _write_ply, "obj": _write_obj, "glb": _write_glb}
    return [path for kind in formats for path in writers[kind](_paths(folder, kind)[0], world, turned, looks)]


_WHAT = "surface of an unmix-nerf run"


def _write_ply(
    path: Path, mesh: Mesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceLooks
) -> list[Path]:
    vertices = {
        **{name: mesh.vertices[:, axis] for axis, name in enumerate("xyz")},
        **{f"n{name}": normals[:, axis] for axis, name in enumerate("xyz")},
        **looks.properties(),
    }
    return [write_ply(path, vertices, mesh.faces, looks.comments(_WHAT))]


def _write_obj(
    path: Path, mesh: Mesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceLooks
) -> list[Path]:
    materials = _majority(looks.material_ids.astype(np.int64)[mesh.faces])
    return write_obj(
        path.with_suffix(""),
        mesh.vertices,
        normals,
        looks.srgb,
        mesh.faces,
        materials,
        looks.materials.names,
        looks.palette,
        looks.comments(_WHAT),
    )


def _write_glb(
    path: Path, mesh: Mesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceLooks
) -> list[Path]:
    numbers = {"_MATERIAL": looks.material_ids.astype(np.float32)}
    for name, values in looks.properties().items():
        if name.startswith("abundance_"):
            numbers[f"_{name.upper()}"] = values
    extras = {"materials": list(looks.materials.names), "about": looks.comments(_WHAT)[:2]}
    return [write_glb(path, mesh.vertices, normals, looks.linear_rgb, mesh.faces, numbers, extras)]


def _paths(folder: Path, kind: MeshFormat) -> list[Path]:
    return obj_paths(folder / "mesh") if kind == "obj" else [folder / f"mesh.{kind}"]


def _majority(corners: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " F"]:
    """The material that most corners of a face have, that of the first where all differ."""
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])


def _links(mesh: Mesh):  # noqa: ANN202 - a sparse matrix of scipy, which is imported here only
    """Symmetric matrix (V, V) that is not 0 where an edge joins two vertices."""
    from scipy.sparse import coo_matrix

    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    both = np.concatenate([edges, edges[:, ::-1]])
    count = len(mesh.vertices)
    return coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
