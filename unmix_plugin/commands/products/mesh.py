"""`unmix-export mesh`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.products.product_formats import MeshFormat

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
    ones drop haze."""
    smoothing: float = 1.0
    """Blur before the surface is looked for: standard deviation in cells, 0 for none."""
    unseen: Literal["drop", "keep"] = "drop"
    """What to do with surfaces that no camera of the run sees, and that were therefore never learnt."""

    def write(self, job: Job) -> list[Path]:
        """Sample the density, march through it, trim and colour the surface."""
        import numpy as np

        from unmix_plugin.products.mesh import (
            extract_mesh,
            filled,
            mesh_paths,
            require_sound,
            surface_density,
            trim_unseen,
            without_crumbs,
            write_mesh,
        )
        from unmix_plugin.trained.density_grid import GridPoints, sample_slice

        require_sound(self.density, self.smoothing)
        model, frame = job.model, job.frame
        grid = GridPoints.over(model.renderer.aabb, self.resolution)
        job.claim(mesh_paths(job.folder, self.formats))
        surface = job.surface(_NUM_RAYS)
        densities = np.stack(
            [
                sample_slice(model, grid.slice_points(index))[0]
                for index in job.follow("sampling the density", range(grid.shape[0]))
            ]
        )
        with job.working("making the mesh"):
            threshold = (
                surface_density(model, surface.points())
                if self.density is None
                else self.density / frame.scale
            )
            pixel_size = float(model.metadata["pixel_size"])
            if self.unseen == "drop":
                densities = filled(densities, grid, model, surface)
            mesh = extract_mesh(densities, grid, threshold, self.smoothing, pixel_size)
            mesh = without_crumbs(mesh if self.unseen == "keep" else trim_unseen(mesh, surface))
            written = write_mesh(job.folder, self.formats, mesh, model, frame)
        job.say(
            f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, "
            f"at a density of {threshold * frame.scale:.4g} per world unit"
        )
        return written
