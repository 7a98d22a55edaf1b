"""`unmix-export point-cloud`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.commands.products.product import Job, Product


@dataclass(frozen=True)
class PointCloud(Product):
    """The surface as points: points.ply with position and normal in the scene's world coordinates, colour, material and
    every abundance of each point, and with --outputs more numbers."""

    name = "point-cloud"

    num_points: int = 100_000
    """Most points to write; they cover what the run's cameras see evenly."""
    outputs: tuple[str, ...] = ()
    """Numbers to add to each point: spectral indices and targets, as in index:ndvi target:ace:paint.csv."""

    def write(self, job: Job) -> list[Path]:
        """Look through all cameras of the run, clean and thin what they see."""
        from unmix_plugin.products.point_cloud import (
            RAYS_PER_POINT,
            point_cloud_path,
            require_count,
            write_point_cloud,
        )
        from unmix_plugin.products.point_scores import require_point_scores

        count = require_count(self.num_points)
        materials = job.materials
        scores = require_point_scores(self.outputs, materials.bands)
        job.claim([point_cloud_path(job.folder)])
        surface = job.surface(RAYS_PER_POINT * count)
        with job.working("cleaning and thinning the points"):
            path, written = write_point_cloud(
                job.folder, surface.points(), count, materials, job.frame, scores
            )
        job.say(f"{written} points")
        return [path]
