"""The surface as a cloud of points with mixture, spectral indices, scores of targets, and spectra: PLY, LAS, LAZ.

Points are the ends of rays of the run's own cameras where nearly all of a ray ends, and where the cameras agree on it;
lone points are left out, and the rest is thinned evenly. Normals are those of planes through the neighbours.

Notation: `P` points, `B` bands.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from unmix_plugin.errors import ConfigError, RunError, counted
from unmix_plugin.formats.las import require_laspy, write_las
from unmix_plugin.formats.meshes import with_scalar_fields, write_ply
from unmix_plugin.products.mesh import xyz_columns
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import PointCloud
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import NAMED_INDICES
from unmix_plugin.spectral.materials import Materials, seen_reflectance
from unmix_plugin.trained.outputs import find_output
from unmix_plugin.trained.reflectance_maps import ReflectanceMap, is_reflectance_map, parse_reflectance_map
from unmix_plugin.trained.run_views import directions_to_world, positions_for_files
from unmix_plugin.trained.surface import SeenSurface, SurfaceAppearance, SurfacePoints
from unmix_plugin.trained.trained_scene import TrainedScene

_OUTLIER_NEIGHBOURS = 8
_OUTLIER_FACTOR = 4.0
"""Points whose neighbours are, on average, farther by this factor than those of the median point, are outliers."""

_PLANE_NEIGHBOURS = 24
_CHUNK = 50_000
_BISECTIONS = 20


def even_cover(points: SurfacePoints, count: int) -> tuple[SurfacePoints, Float[np.ndarray, "kept 3"]]:
    """At most `count` points that cover the same surface evenly, without stray ones, and their unit normals.

    Raises:
        RunError: there are no points.
    """
    points = points.select(torch.from_numpy(~_is_outlier(points.positions.numpy())))
    if len(points) == 0:
        raise RunError(
            "no ray of the run's cameras ends on a surface: train longer, or there is nothing to export"
        )
    positions = points.positions.double().numpy()
    chosen = _thinned(positions, count)
    normals = _plane_normals(positions, -points.directions.double().numpy(), chosen)
    return points.select(torch.from_numpy(chosen)), normals


def _is_outlier(positions: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
    """Which points lie far from all others, by the mean distance to their nearest eight."""
    if len(positions) <= _OUTLIER_NEIGHBOURS:
        return np.zeros(len(positions), dtype=bool)
    from scipy.spatial import KDTree

    distances, _ = KDTree(positions).query(positions, k=_OUTLIER_NEIGHBOURS + 1)
    to_others = distances[:, 1:].mean(axis=1)
    return to_others > _OUTLIER_FACTOR * np.median(to_others)


def _thinned(positions: Float[np.ndarray, "P 3"], count: int) -> Int64[np.ndarray, " kept"]:
    """Indices of at most `count` points, evenly spread: of each cube of a grid, the point nearest to their mean.

    The grid is the finest that has not more than `count` cubes with points in them.
    """
    if len(positions) <= count:
        return np.arange(len(positions))
    low = positions.min(axis=0)
    extent = float((positions - low).max())
    fine, coarse = 0.0, 2.0 * max(extent, 1e-12)
    for _ in range(_BISECTIONS):
        edge = (fine + coarse) / 2
        cubes = len(np.unique(_cube_numbers(positions - low, edge)))
        fine, coarse = (fine, edge) if cubes <= count else (edge, coarse)
    numbers = _cube_numbers(positions - low, coarse)
    _, group, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, weights=column) for column in positions.T], axis=1)
    off = np.linalg.norm(positions - (sums / counts[:, None])[group], axis=1)
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return np.sort(np.lexsort((off, group))[firsts])


def _plane_normals(
    positions: Float[np.ndarray, "P 3"],
    towards: Float[np.ndarray, "P 3"],
    wanted: Int64[np.ndarray, " chosen"],
) -> Float[np.ndarray, "chosen 3"]:
    """Unit normals of the planes through the neighbours of some points."""
    if len(positions) < 3:
        vectors = towards[wanted]
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(min=1e-12)
    from scipy.spatial import KDTree

    tree = KDTree(positions)
    count = min(_PLANE_NEIGHBOURS, len(positions))
    normals = np.empty((len(wanted), 3))
    for start in range(0, len(wanted), _CHUNK):
        chosen = wanted[start : start + _CHUNK]
        _, neighbours = tree.query(positions[chosen], k=count)
        around = positions[neighbours]
        around = around - around.mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(around.swapaxes(1, 2) @ around)
        normals[start : start + _CHUNK] = axes[:, :, 0]
    return normals * np.where((normals * towards[wanted]).sum(axis=1, keepdims=True) < 0, -1, 1)


def _cube_numbers(offsets: Float[np.ndarray, "P 3"], edge: float) -> Int64[np.ndarray, " P"]:
    cells = (offsets / edge).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    return (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]


_LONGEST_COMMENT = 300


@dataclass(frozen=True)
class PointScore:
    """A number to add to every point."""

    output: str
    """As asked for, such as `index:ndvi`."""
    property: str
    """What files call it, such as `index_ndvi`."""
    map: ReflectanceMap

    def values(
        self, diffuse: Float[Tensor, "P B"], light: Float[Tensor, "B"] | None
    ) -> Float32[np.ndarray, " P"]:
        """The numbers, relative to all the points given where a target needs a background; NaN where undefined."""
        opaque = torch.ones(len(diffuse), dtype=diffuse.dtype)
        reflectance = seen_reflectance(diffuse, opaque, light)
        return self.map.fit(reflectance)(reflectance).numpy().astype(np.float32)

    def comments(self, materials: Materials) -> list[str]:
        """What a file says of it, and what its numbers stand for where they are ids."""
        caveat = "" if materials.is_light_known else "; of radiance, since the scene's light is unknown"
        comment = f"{self.property}: {self.output}, {self.map.what}"[:_LONGEST_COMMENT] + caveat
        classes = enumerate(self.map.classes)
        return [comment, *(f"{self.property} {index}: {name}" for index, (name, _) in classes)]


def point_scores(
    outputs: Sequence[str], bands: Bands, lit: Bool[Tensor, "B"] | None = None
) -> list[PointScore]:
    """Numbers to add to points, each once; called `index_ndvi` of a named index, else by kind and number: formats know
    few characters."""
    scores: dict[str, PointScore] = {}
    counts: Counter[str] = Counter()
    for asked in outputs:
        kind, colon, argument = asked.partition(":")
        plain = argument.strip().lower()
        is_named = kind == "index" and plain in NAMED_INDICES
        output = f"{kind}{colon}{plain}" if is_named else asked
        if not is_reflectance_map(output) or not argument:
            raise ConfigError(
                f"--outputs {output}: points take spectral indices, index:NAME or index:FORMULA such as "
                "index:ndvi, targets, target:FILE.csv or target:ace:FILE.csv, library:FILE and absorption:LOW-HIGH; "
                "colour, material and abundances are in every cloud"
            )
        if output not in scores:
            counts[kind] += not is_named
            name = f"index_{plain.replace('-', '_')}" if is_named else f"{kind}_{counts[kind]}"
            scores[output] = PointScore(output, name, parse_reflectance_map(output, bands, lit))
    return list(scores.values())


_RAYS_PER_POINT = 5
"""Rays cast for each point asked for: many miss, and an even cover needs a choice."""

_COUNT_BOUNDS = (1, 10_000_000)


def export(job: Job, asked: PointCloud) -> list[Path]:
    """Look through all cameras of the run, clean and thin what they see."""
    (low, high), count, materials = _COUNT_BOUNDS, asked.num_points, job.materials
    if not low <= count <= high:
        raise ConfigError(f"--num-points is {count}; choose {low} to {high}")
    scores = point_scores(asked.outputs, materials.bands, materials.is_lit)
    for score in scores:
        find_output(score.output, materials)  # which refuses libraries through another sensor
    if asked.spectra == "reflectance" and not materials.is_light_known:
        raise ConfigError(
            "--spectra reflectance needs the light of the scene, which is not known; ask for --spectra radiance"
        )
    if {"las", "laz"} & set(asked.formats):
        require_laspy("laz" in asked.formats)
    paths = [job.folder / f"points.{kind}" for kind in dict.fromkeys(asked.formats)]
    if not paths:
        raise ConfigError("--formats names no format; choose ply, las or laz")
    job.claim(paths)
    cameras = [view.camera for view in job.views("all")]
    surface = SeenSurface(job.scene, _RAYS_PER_POINT * count, cameras, job.follow)
    with job.working("cleaning and thinning the points"):
        written = write_point_cloud(
            paths, surface.points(), count, job.scene, job.frame, scores, asked.spectra
        )
    job.say(counted(written, "point"))
    return paths


def write_point_cloud(
    paths: Sequence[Path],
    points: SurfacePoints,
    num_points: int,
    scene: TrainedScene,
    frame: Normalisation,
    scores: Sequence[PointScore] = (),
    spectra: Literal["none", "radiance", "reflectance"] = "none",
) -> int:
    """Write at most so many points, binary, in world coordinates, to each file in the format of its suffix; say how
    many.

    x y z (float32, float64 where coordinates are large), nx ny nz (float32), red green blue (uint8, sRGB of the diffuse
    spectrum), material (uint8), every abundance, every score and the diffuse spectrum if asked for (float32).
    """
    materials = scene.materials
    kept, normals = even_cover(points, num_points)
    diffuse = kept.diffuse(materials)
    looks = SurfaceAppearance(materials, kept.abundances, diffuse, scene.scale)
    world = positions_for_files(frame.to_world(kept.positions.double().numpy()))
    turned = directions_to_world(frame, normals).astype(np.float32)
    vertices = {
        **xyz_columns(world),
        **xyz_columns(turned, "n"),
        **looks.properties(),
        **{score.property: score.values(diffuse, materials.light) for score in scores},
    }
    comments = looks.comments("surface points of an unmix-nerf run")
    comments += [comment for score in scores for comment in score.comments(materials)]
    if spectra != "none":  # of reflectance NaN where the light is dark
        light = materials.light if spectra == "reflectance" else None
        values = seen_reflectance(diffuse, torch.ones(len(diffuse), dtype=diffuse.dtype), light).numpy()
        for index, nm in enumerate(materials.bands.centers_nm):
            name = f"{spectra}_{nm:.10g}nm".replace(".", "_")
            vertices[name] = values[:, index].astype(np.float32)
        comments.append(f"{spectra}_NUMBERnm: the diffuse spectrum at each band")
    for path in paths:
        if path.suffix in (".las", ".laz"):
            write_las(path, vertices, comments)
        else:
            named, said = with_scalar_fields(vertices, comments)
            write_ply(path, named, comments=said)
    return len(kept)
