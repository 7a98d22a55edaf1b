"""`unmix-export cubes`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.products.product_formats import CubeFormat
from unmix_plugin.trained.run_views import ViewChoice


@dataclass(frozen=True)
class Cubes(Product):
    """Spectral images: of each view radiance on black, (H, W, bands) float32, 1 = full scale, as ENVI (VIEW.hdr and
    VIEW.img), spectral OpenEXR (VIEW.exr) or VIEW.npy."""

    name = "cubes"

    views: ViewChoice = "eval"
    """Which of the scene's views to render."""
    formats: tuple[CubeFormat, ...] = ("envi",)
    """envi, exr, npy."""

    def write(self, job: Job) -> list[Path]:
        """Render the views, one after the other, and write each."""
        from unmix_plugin.products.cubes import cube_paths, write_cube
        from unmix_plugin.trained.view_rendering import render_view

        bands, views = job.materials.bands, job.views(self.views)
        job.claim([path for view in views for path in cube_paths(job.folder, view.name, self.formats)])
        written: list[Path] = []
        for view in job.follow("rendering views", views):
            rendered = render_view(job.loaded.model, view.camera)
            written += write_cube(job.folder, view.name, rendered, bands, self.formats)
        return written
