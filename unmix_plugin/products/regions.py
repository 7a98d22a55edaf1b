"""Regions of a run's surface: how large they are, their mean spectrum with its spread, and what they are made of.

All is weighted by area (`TriangleMesh.areas`), on the surface that `mesh` exports.

Notation: `V` vertices, `F` faces, `P` points, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.envi import envi_library_paths, write_envi_library
from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.products.mesh import TriangleMesh, find_surface
from unmix_plugin.products.product import Job
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.measures import Scale, describe_area, keep_region
from unmix_plugin.trained.regions import Box, InView, OfMaterial, Region, check_name, polygon_mask
from unmix_plugin.trained.run_views import find_view
from unmix_plugin.trained.surface import SeenSurface, SurfaceAppearance, look_from_above
from unmix_plugin.trained.trained_scene import TrainedScene

_CELLS_PER_PIXEL, _RESOLUTIONS = 2, (48, 256)
"""Along the longest edge of the scene box, and the least and most cells there."""
_PARTS = ((2, 2, 2), (4, 1, 1), (1, 4, 1), (1, 1, 4))
"""Points of a triangle that tell how much of it is in a region, by their shares of its corners, in sixths."""


@dataclass(frozen=True)
class MeasuredRegion:
    """What a part of a surface is."""

    area: float
    """Square units of the world."""
    mean: Float64[np.ndarray, " B"]
    """Spectrum without the view-dependent part."""
    spread: Float64[np.ndarray, " B"]
    """Standard deviation over the area."""
    abundances: Float64[np.ndarray, " K"]
    """Summing to 1."""

    def said(self, names: Sequence[str], scale: Scale | None) -> str:
        """Area and largest shares for people."""
        largest = np.argsort(-self.abundances)[:3]
        shares = ", ".join(f"{names[index]} {self.abundances[index]:.2f}" for index in largest)
        return f"{describe_area(self.area, scale)}: {shares}"


class MeasuredSurface:
    """The surface of a scene, in which any region can be measured."""

    def __init__(self, scene: TrainedScene, mesh: TriangleMesh) -> None:
        """
        Args:
            scene: Unedited or edited.
            mesh: Its surface, model space.
        """
        self._scene, self.mesh = scene, mesh
        positions, normals = (torch.from_numpy(values).float() for values in (mesh.vertices, mesh.normals))
        self._abundances, self._diffuse = look_from_above(scene, positions, normals)
        self._materials = SurfaceAppearance(scene.materials, self._abundances, self._diffuse).material_ids

    @cached_property
    def areas(self) -> Float64[np.ndarray, " F"]:
        """Of the triangles, square units of the world."""
        return self.mesh.areas() / self._scene.frame.scale**2

    def shares(self, region: Region) -> Float64[np.ndarray, "F 3"]:
        """How much of each third of a triangle, that of a corner, is in a region: 0 to 1."""
        faces = self.mesh.faces
        if isinstance(region, OfMaterial):
            return _in_material(self._scene, region, self._materials)[faces].astype(np.float64)
        corners, weights = self.mesh.vertices[faces], np.array(_PARTS) / 6
        points = np.einsum("pc,fcx->fpx", weights, corners).reshape(-1, 3)
        inside = points_in(self._scene, region, torch.from_numpy(points).float())
        return inside.reshape(len(faces), len(_PARTS)) @ weights / weights.sum(axis=0)

    def measure(self, region: Region, name: str) -> MeasuredRegion:
        """What a region is.

        Raises:
            ConfigError: nothing of the surface is in it, or the scene has no such material.
        """
        weights = self.shares(region) * (self.areas / 3)[:, None]
        area = float(weights.sum())
        if area <= 0:
            low, high = (self._scene.frame.to_world(self.mesh.vertices).round(3) for _ in range(2))
            raise ConfigError(
                f"the region {name} has nothing of the surface in it, which lies between "
                f"{' '.join(f'{x:g}' for x in low.min(axis=0))} and {' '.join(f'{x:g}' for x in high.max(axis=0))} "
                "of the world"
            )
        share = (
            np.bincount(self.mesh.faces.ravel(), weights=weights.ravel(), minlength=len(self.mesh.vertices))
            / area
        )
        spectra = self._diffuse.double().numpy()
        mean = share @ spectra
        spread = np.sqrt(share @ (spectra - mean) ** 2)
        return MeasuredRegion(area, mean, spread, share @ self._abundances.double().numpy())


def points_in(
    scene: TrainedScene, region: Box | InView, positions: Float[Tensor, "P 3"]
) -> Bool[np.ndarray, " P"]:
    """Which points of a scene's surface are in a box or in a part of a view.

    Args:
        positions: Model space, on the CPU.
    """
    if isinstance(region, Box):
        world = scene.frame.to_world(positions.double().numpy())
        return np.all((world >= region.low) & (world <= region.high), axis=1, keepdims=False)
    camera = region.camera.to("cpu")
    coords, depths = camera.project(positions, 0)
    mask = region.mask()
    height, width = mask.shape
    inside = (depths > 0) & (coords >= 0).all(dim=-1) & (coords < torch.tensor([width, height])).all(dim=-1)
    columns, rows = coords[inside].long().numpy().T
    inside[inside.clone()] = torch.from_numpy(mask[rows, columns])
    if bool(inside.any()):
        seen = SeenSurface(scene, width * height, [camera])
        seen.look(camera)
        inside[inside.clone()] = seen.shows(positions[inside])
    return inside.numpy()


def _in_material(
    scene: TrainedScene, region: OfMaterial, materials: UInt8[np.ndarray, " V"]
) -> Bool[np.ndarray, " V"]:
    if region.material >= len(scene.materials.names):
        raise ConfigError(f"the scene has no material {region.material}; it has {len(scene.materials.names)}")
    return np.asarray(materials == region.material)


def measured_surface(job: Job) -> MeasuredSurface:
    """The surface of a run, ready to be measured."""
    cells = _CELLS_PER_PIXEL * float(job.scene.scene_box.size.max()) / job.scene.pixel_size
    mesh, _ = find_surface(job, round(min(max(cells, _RESOLUTIONS[0]), _RESOLUTIONS[1])))
    with job.working("looking at the surface's points"):
        return MeasuredSurface(job.scene, mesh)


def export_regions(job: Job) -> list[Path]:
    """Write regions.csv (area and abundances of each kept region and of each material), regions-spectra.csv (mean and
    standard deviation), and the means as the library regions.sli."""
    table, spectra = job.folder / "regions.csv", job.folder / "regions-spectra.csv"
    job.claim([table, spectra, *envi_library_paths(job.folder / "regions")])
    surface, names, scale = measured_surface(job), job.materials.names, job.scene.scale
    found: dict[str, MeasuredRegion] = {}
    materials = {f"material {name}": OfMaterial(index) for index, name in enumerate(names)}
    for name, region in {**job.loaded.measures.regions, **materials}.items():
        try:
            found[name] = surface.measure(region, name)
        except ConfigError as error:  # noqa: PERF203 - said, and the others are measured
            job.say(str(error))
    factor = None if scale is None else 1e4 * scale.metres_per_unit**2
    rows = [["name", "area_square_units", "area_cm2", *names]]
    for name, one in found.items():
        area_cm2 = "" if factor is None else f"{one.area * factor:.6g}"
        rows.append([name, f"{one.area:.6g}", area_cm2, *(f"{share:.6g}" for share in one.abundances)])
        job.say(f"{name}: {one.said(names, scale)}")
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    make_folder(job.folder)
    write_file(table, text.getvalue().encode())
    columns = {
        f"{name} {what}": values
        for name, one in found.items()
        for what, values in (("mean", one.mean), ("standard deviation", one.spread))
    }
    bands = job.materials.bands
    write_spectra_csv(
        spectra, SpectraTable(bands, tuple(columns), np.stack(list(columns.values())).clip(min=0))
    )
    means = np.stack([one.mean for one in found.values()]).astype(np.float32)
    written = write_envi_library(
        job.folder / "regions", means, bands, tuple(found), "mean spectra of regions"
    )
    return [table, spectra, *written]


@dataclass(frozen=True)
class RegionRequest:
    """A region as the command line has it; exactly one of box, material, polygon and mask."""

    box: tuple[str, str] | None = None
    material: str | None = None
    view: str | None = None
    polygon: str | None = None
    mask: Path | None = None


def change_regions(job: Job, name: str | None, removed: str | None, asked: RegionRequest) -> list[Path]:
    """Keep a region with the run, after a look at what is in it, or forget one."""
    if removed is not None and name is None and asked == RegionRequest():
        return [keep_region(job.loaded.folder, removed, None)]
    if name is None or removed is not None:
        raise ConfigError("give --add NAME with what the region is, or --remove NAME alone")
    name, region = check_name(name), _requested(job, asked)
    found = measured_surface(job).measure(region, name)
    path = keep_region(job.loaded.folder, name, region)
    job.say(f"{name}: {found.said(job.materials.names, job.scene.scale)}")
    return [path]


def _requested(job: Job, asked: RegionRequest) -> Region:
    given = [what for what in (asked.box, asked.material, asked.polygon, asked.mask) if what is not None]
    if len(given) != 1 or (asked.view is not None) != (asked.polygon is not None or asked.mask is not None):
        raise ConfigError("give one of --box, --material, --view with --polygon, and --view with --mask")
    if asked.box is not None:
        from unmix_plugin.products.measuring import find_point

        first, second = (find_point(job, text) for text in asked.box)
        low, high = np.minimum(first, second).tolist(), np.maximum(first, second).tolist()
        return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    if asked.material is not None:
        names = job.materials.names
        if asked.material in names:
            return OfMaterial(names.index(asked.material))
        if asked.material.isdecimal() and int(asked.material) < len(names):
            return OfMaterial(int(asked.material))
        raise ConfigError(f"no material {asked.material!r}; there are {', '.join(names)}, or numbers from 0")
    assert asked.view is not None
    view = find_view(job.views("eval"), asked.view, job.views("train"))
    size = view.camera.size(0)
    if asked.polygon is not None:
        return InView.of_mask(view.camera, polygon_mask(_corners(asked.polygon), size))
    assert asked.mask is not None
    return InView.of_mask(view.camera, _read_mask(asked.mask, size))


def _corners(text: str) -> list[tuple[float, float]]:
    try:
        pairs = [[float(number) for number in pair.split(",")] for pair in text.split()]
    except ValueError:
        pairs = [[]]
    if not all(len(pair) == 2 and all(abs(number) < 1e6 for number in pair) for pair in pairs):
        raise ConfigError(f"--polygon {text!r}: expected columns and rows, such as '120,80 180,80 150,140'")
    return [(pair[0], pair[1]) for pair in pairs]


def _read_mask(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """A picture in which what is brighter than half is in the region."""
    from unmix_plugin.scenes.reading.images import UnreadableImageError, read_mask

    try:
        mask = read_mask(path, (size[1], size[0]))
    except UnreadableImageError as error:
        raise ConfigError(f"the mask {path} {error}") from error
    if not mask.any():
        raise ConfigError(f"{path} has no bright pixel; white is what is in the region")
    return mask
