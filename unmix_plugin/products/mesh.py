"""The scene's surface as a mesh: PLY, glTF and OBJ.

Notation: `V` vertices, `F` faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float32, Int

from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.formats.meshes import obj_paths, write_glb, write_obj, write_ply
from unmix_plugin.products.product import Job, Product

if TYPE_CHECKING:
    from unmix_plugin.products.mesh_extraction import TriangleMesh
    from unmix_plugin.scenes.scene import Normalisation
    from unmix_plugin.trained.density_grid import GridPoints
    from unmix_plugin.trained.surface import SeenSurface
    from unmix_plugin.trained.surface_appearance import SurfaceAppearance
    from unmix_plugin.trained.trained_scene import TrainedScene

MeshFormat = Literal["ply", "glb", "obj"]

_MOST_SMOOTHING = 8.0
_NUM_RAYS = 300_000
"""Rays that tell what of the surface is seen."""


@dataclass(frozen=True)
class Mesh(Product):
    """The surface as triangles: mesh.ply, mesh.glb or mesh.obj with position and normal in the scene's world
    coordinates, colour and material; PLY and GLB with every abundance too."""

    name = "mesh"

    formats: tuple[MeshFormat, ...] = ("ply", "glb")
    """ply, glb, obj (with mesh.mtl)."""
    resolution: int = 192
    """Cells along the longest edge of the scene box."""
    density: float | None = None
    """Density per world unit at which the surface lies; None: that at which rays end. Lower ones close holes, higher
    ones drop floaters."""
    smoothing: float = 1.0
    """Blur before the surface is looked for: standard deviation in cells, 0 for none."""
    unseen: Literal["drop", "keep"] = "drop"
    """What to do with surfaces that no camera of the run sees, and that were therefore never learnt."""

    def write(self, job: Job) -> list[Path]:
        """Sample the density, march through it, trim and colour the surface."""
        from unmix_plugin.products.mesh_extraction import surface_density

        require_sound(self.density, self.smoothing)
        job.claim(mesh_paths(job.folder, self.formats))
        surface, densities, grid = job.surface(_NUM_RAYS), *self._sample(job)
        with job.working("making the mesh"):
            if self.density is None:
                threshold = surface_density(job.scene, surface.points())
            else:
                threshold = self.density / job.frame.scale
            mesh = self._extract(job, densities, grid, threshold, surface)
            written = write_mesh(job.folder, self.formats, mesh, job.scene, job.frame)
        job.say(
            f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, "
            f"at a density of {threshold * job.frame.scale:.4g} per world unit"
        )
        return written

    def _sample(self, job: Job) -> tuple[Float32[np.ndarray, "X Y Z"], GridPoints]:
        from unmix_plugin.trained.density_grid import GridPoints, sample_slice

        scene = job.scene
        grid = GridPoints.over(scene.scene_box.aabb, self.resolution)
        slices = job.follow("sampling the density", range(grid.shape[0]))
        return np.stack([sample_slice(scene, grid.slice_points(index))[0] for index in slices]), grid

    def _extract(
        self,
        job: Job,
        densities: Float32[np.ndarray, "X Y Z"],
        grid: GridPoints,
        threshold: float,
        surface: SeenSurface,
    ) -> TriangleMesh:
        """The surface, model space."""
        from unmix_plugin.products.mesh_extraction import (
            extract_mesh,
            filled,
            trim_unseen,
            without_stray_pieces,
        )

        pixel_size = job.scene.pixel_size
        if self.unseen == "keep":
            return without_stray_pieces(extract_mesh(densities, grid, threshold, self.smoothing, pixel_size))
        solid = filled(densities, grid, job.scene, surface)
        mesh = extract_mesh(solid, grid, threshold, self.smoothing, pixel_size)
        return without_stray_pieces(trim_unseen(mesh, surface))


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


def write_mesh(
    folder: Path,
    formats: tuple[MeshFormat, ...],
    mesh: TriangleMesh,
    scene: TrainedScene,
    frame: Normalisation,
) -> list[Path]:
    """Write a mesh with the colour, material and abundances of each vertex, seen from straight above it.

    PLY carries all of it; glTF positions, normals, colours (linear), `_MATERIAL` and abundances; OBJ positions,
    normals, colours (sRGB) and the material of each face. Large coordinates are float64 in PLY and OBJ; glTF has them
    less `offset` in the extras of its mesh.

    Args:
        folder: Where to write; it is made.
        formats: Which.
        mesh: Model space.
        scene: Trained.
        frame: From the scene's world to model space; files are in world coordinates.
    Raises:
        RunError: there is no face, or the disk is full or refuses.
    """
    from unmix_plugin.products.mesh_extraction import TriangleMesh
    from unmix_plugin.trained.surface import look_from_above
    from unmix_plugin.trained.surface_appearance import SurfaceAppearance
    from unmix_plugin.trained.world_frame import directions_to_world, positions_for_files

    if len(mesh.faces) == 0:
        raise RunError(
            "nothing is left of the surface: no camera of the run sees it; keep it with --unseen keep"
        )
    normals = mesh.normals
    positions = torch.from_numpy(mesh.vertices).float()
    seen = look_from_above(scene, positions, torch.from_numpy(normals).float())
    looks = SurfaceAppearance(scene.materials, *seen)
    world = TriangleMesh(positions_for_files(frame.to_world(mesh.vertices)), mesh.faces)
    turned = directions_to_world(frame, normals).astype(np.float32)
    writers = {"ply": _write_ply, "obj": _write_obj, "glb": _write_glb}
    return [path for kind in formats for path in writers[kind](_paths(folder, kind)[0], world, turned, looks)]


_WHAT = "surface of an unmix-nerf run"


def _write_ply(
    path: Path, mesh: TriangleMesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceAppearance
) -> list[Path]:
    vertices = {
        **{name: mesh.vertices[:, axis] for axis, name in enumerate("xyz")},
        **{f"n{name}": normals[:, axis] for axis, name in enumerate("xyz")},
        **looks.properties(),
    }
    return [write_ply(path, vertices, mesh.faces, looks.comments(_WHAT))]


def _write_obj(
    path: Path, mesh: TriangleMesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceAppearance
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
    path: Path, mesh: TriangleMesh, normals: Float32[np.ndarray, "V 3"], looks: SurfaceAppearance
) -> list[Path]:
    numbers = {"_MATERIAL": looks.material_ids.astype(np.float32)}
    for name, values in looks.properties().items():
        if name.startswith("abundance_"):
            numbers[f"_{name.upper()}"] = values
    extras = {"materials": list(looks.materials.names), "about": looks.comments(_WHAT)[:2]}
    vertices = mesh.vertices
    if vertices.dtype == np.float64:  # glTF has float32 only
        extras["offset"] = np.round(vertices.mean(axis=0)).tolist()
        vertices = vertices - extras["offset"]
    positions = vertices.astype(np.float32)
    return [write_glb(path, positions, normals, looks.linear_rgb, mesh.faces, numbers, extras)]


def _paths(folder: Path, kind: MeshFormat) -> list[Path]:
    return obj_paths(folder / "mesh") if kind == "obj" else [folder / f"mesh.{kind}"]


def _majority(corners: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " F"]:
    """The material that most corners of a face have, that of the first where all differ."""
    return np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
