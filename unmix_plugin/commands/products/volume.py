"""`unmix-export volume`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.commands.products.product import Job, Product


@dataclass(frozen=True)
class Volume(Product):
    """Density and abundances on a regular grid: volume.npz with `density` (X, Y, Z), per world unit, `abundances`
    (X, Y, Z, K), the matrix `index_to_world`, and names and spectra of the endmembers."""

    name = "volume"

    resolution: int = 128
    """Cells along the longest edge of the scene box."""

    def write(self, job: Job) -> list[Path]:
        """Sample the field, slice by slice."""
        from unmix_plugin.products.volume import volume_path, write_volume
        from unmix_plugin.trained.density_grid import GridPoints

        model = job.model
        grid = GridPoints.over(model.renderer.aabb, self.resolution)
        job.claim([volume_path(job.folder)])
        slices = job.follow("sampling the field", range(grid.shape[0]))
        return [write_volume(job.folder, model, grid, job.frame, slices)]
