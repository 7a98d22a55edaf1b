"""`unmix-export pca`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.trained.run_views import ViewChoice


@dataclass(frozen=True)
class Pca(Product):
    """Principal components as colours, the same in all views: VIEW.png, pixel by pixel, and components.csv, which says
    what red, green and blue stand for."""

    name = "pca"

    of: Literal["spectra", "abundances"] = "spectra"
    """What has its components taken."""
    views: ViewChoice = "eval"
    """Which of the scene's views to render."""

    def write(self, job: Job) -> list[Path]:
        """Find the components of all views, then paint each."""
        from unmix_plugin.products.pca import (
            components_path,
            find_components,
            pca_path,
            survey_view,
            write_components,
            write_pca,
        )
        from unmix_plugin.trained.view_rendering import render_view

        materials, views, model = job.materials, job.views(self.views), job.loaded.model
        job.claim([*(pca_path(job.folder, view.name) for view in views), components_path(job.folder)])
        looks = [survey_view(model, view.camera, self.of) for view in job.follow("finding components", views)]
        components = find_components(looks, self.of)
        written = [
            write_pca(job.folder, view.name, render_view(model, view.camera), components)
            for view in job.follow("rendering views", views)
        ]
        return [*written, write_components(job.folder, components, materials)]
