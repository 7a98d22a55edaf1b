"""`unmix-export segmentation`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.trained.run_views import ViewChoice


@dataclass(frozen=True)
class Segmentation(Product):
    """Material of each pixel: labels/VIEW.png with ids and their palette (255: nothing), VIEW.npy with scores (H, W, K)
    float32, VIEW.png, a figure with a legend, and legend.csv, which names the ids."""

    name = "segmentation"

    views: ViewChoice = "eval"
    """Which of the scene's views to render."""

    def write(self, job: Job) -> list[Path]:
        """Render the views, one after the other, and write each."""
        from unmix_plugin.products.segmentation import (
            is_legend_there,
            legend_path,
            segmentation_paths,
            write_legend,
            write_segmentation,
        )
        from unmix_plugin.trained.view_rendering import render_view

        materials, views = job.materials, job.views(self.views)
        paths = [path for view in views for path in segmentation_paths(job.folder, view.name)]
        job.claim(paths if is_legend_there(job.folder, materials) else [*paths, legend_path(job.folder)])
        written: list[Path] = []
        for view in job.follow("rendering views", views):
            rendered = render_view(job.loaded.model, view.camera)
            written += write_segmentation(job.folder, view.name, rendered, materials)
        return [*written, write_legend(job.folder, materials)]
