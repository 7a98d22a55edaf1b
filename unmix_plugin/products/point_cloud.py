"""The scene's surface as a cloud of points with their spectra's mixture: PLY.

Points are the ends of rays of the run's own cameras where nearly all of a ray ends, and where the cameras agree on it;
lone points are left out, and the rest is thinned evenly. Normals are those of planes through the neighbours.

Notation: `P` points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from unmix_plugin.errors import ConfigError, RunError, counted
from unmix_plugin.formats.meshes import write_ply
from unmix_plugin.products.cloud import is_outlier, plane_normals, thinned
from unmix_plugin.products.product import Job, Product

if TYPE_CHECKING:
    from unmix_plugin.products.point_scores import PointScore
    from unmix_plugin.scenes.scene import Normalisation
    from unmix_plugin.spectral.materials import Materials
    from unmix_plugin.trained.surface import SurfacePoints

_RAYS_PER_POINT = 5
"""Rays cast for each point asked for: many miss, and an even cover needs a choice."""

_COUNT_BOUNDS = (1, 10_000_000)


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
        from unmix_plugin.products.point_scores import require_point_scores

        count, materials = require_count(self.num_points), job.materials
        scores = require_point_scores(self.outputs, materials.bands)
        job.claim([point_cloud_path(job.folder)])
        surface = job.surface(_RAYS_PER_POINT * count)
        with job.working("cleaning and thinning the points"):
            path, written = write_point_cloud(
                job.folder, surface.points(), count, materials, job.frame, scores
            )
        job.say(counted(written, "point"))
        return [path]


def point_cloud_path(folder: Path) -> Path:
    """The file that `write_point_cloud` makes."""
    return folder / "points.ply"


def require_count(num_points: int) -> int:
    """The number of points asked for.

    Raises:
        ConfigError: none, or more than ten million.
    """
    low, high = _COUNT_BOUNDS
    if not low <= num_points <= high:
        raise ConfigError(f"--num-points is {num_points}; choose {low} to {high}")
    return num_points


def write_point_cloud(
    folder: Path,
    points: SurfacePoints,
    num_points: int,
    materials: Materials,
    frame: Normalisation,
    scores: Sequence[PointScore] = (),
) -> tuple[Path, int]:
    """Write `points.ply`, binary, in world coordinates.

    x y z (float32, float64 where coordinates are large), nx ny nz (float32), red green blue (uint8, sRGB of the diffuse
    spectrum), material (uint8), every abundance and every score (float32).

    Args:
        folder: Where to write; it is made.
        points: Candidates, model space.
        num_points: The most to write.
        materials: The scene's materials.
        frame: From the scene's world to model space.
        scores: More numbers for every point, from its diffuse spectrum; targets take the cloud as background.
    Returns:
        The file, and how many points are in it.
    Raises:
        RunError: there is no point, or the disk is full or refuses.
        SpectrumError: too few points to judge a target against, or all are alike.
    """
    from unmix_plugin.trained.surface_appearance import SurfaceAppearance
    from unmix_plugin.trained.world_frame import directions_to_world, positions_for_files

    points = points.select(torch.from_numpy(~is_outlier(points.positions.numpy())))
    if len(points) == 0:
        raise RunError(
            "no ray of the run's cameras ends on a surface: train longer, or there is nothing to export"
        )
    positions = points.positions.double().numpy()
    chosen = thinned(positions, num_points)
    normals = plane_normals(positions, -points.directions.double().numpy(), chosen)
    kept = points.select(torch.from_numpy(chosen))
    diffuse = kept.diffuse(materials)
    looks = SurfaceAppearance(materials, kept.abundances, diffuse)
    world = positions_for_files(frame.to_world(positions[chosen]))
    turned = directions_to_world(frame, normals).astype(np.float32)
    vertices = {
        **{name: world[:, axis] for axis, name in enumerate("xyz")},
        **{f"n{name}": turned[:, axis] for axis, name in enumerate("xyz")},
        **looks.properties(),
        **{score.property: score.values(diffuse, materials.light) for score in scores},
    }
    comments = looks.comments("surface points of an unmix-nerf run")
    comments += [score.comment(materials) for score in scores]
    return write_ply(point_cloud_path(folder), vertices, comments=comments), len(chosen)
