"""`unmix-export abundances`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.products.product_formats import ShareFormat
from unmix_plugin.trained.run_views import ViewChoice


@dataclass(frozen=True)
class Abundances(Product):
    """Abundance of each endmember, summing to the opacity, 0 where nothing is: of each view VIEW.npy, (H, W, K)
    float32, and VIEW.png, a figure; on request ENVI and EXR images."""

    name = "abundances"

    views: ViewChoice = "eval"
    """Which of the scene's views to render."""
    formats: tuple[ShareFormat, ...] = ("npy", "png")
    """npy, envi (.hdr and .img), exr (a channel for each endmember), png."""

    def write(self, job: Job) -> list[Path]:
        """Render the views, one after the other, and write each."""
        from unmix_plugin.products.abundances import abundance_paths, write_abundances
        from unmix_plugin.trained.view_rendering import render_view

        materials, views = job.materials, job.views(self.views)
        job.claim([path for view in views for path in abundance_paths(job.folder, view.name, self.formats)])
        written: list[Path] = []
        for view in job.follow("rendering views", views):
            rendered = render_view(job.loaded.model, view.camera)
            written += write_abundances(job.folder, view.name, rendered, materials, self.formats)
        return written
