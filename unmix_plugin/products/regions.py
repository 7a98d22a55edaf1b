"""What users measure in a run: named regions, with area, mean spectrum and mixture, and the scale."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.envi import envi_library_paths, write_envi_library
from unmix_plugin.formats.files import csv_bytes, make_folder, write_file
from unmix_plugin.products import scene_products
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Regions
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, find_endmember
from unmix_plugin.trained.measured_surface import MeasuredRegion, MeasuredSurface
from unmix_plugin.trained.measures import (
    Scale,
    describe_scale,
    keep_region,
    keep_scale,
    require_on_surface,
    scale_between,
)
from unmix_plugin.trained.regions import Box, InView, OfMaterial, Region, check_name, polygon_mask
from unmix_plugin.trained.run_views import find_view


def measured_surface(job: Job) -> MeasuredSurface:
    """The surface of a run, ready to be measured."""
    return MeasuredSurface.of(job.scene, job.follow, job.working)


def measure_regions(
    surface: MeasuredSurface, regions: Mapping[str, Region]
) -> tuple[dict[str, MeasuredRegion], dict[str, str]]:
    """What each region is, by its name; and why others could not be measured."""
    found: dict[str, MeasuredRegion] = {}
    failed: dict[str, str] = {}
    for name, region in regions.items():
        try:
            found[name] = surface.measure(region, name)
        except ConfigError as error:  # noqa: PERF203 - said, and the others are measured
            failed[name] = str(error)
    return found, failed


def export(job: Job, asked: Regions) -> list[Path]:
    """Keep a region with the run, after a look at what is in it, or forget one; otherwise measure all of them."""
    described = (asked.add, asked.box, asked.material, asked.view, asked.polygon, asked.mask)
    if all(what is None for what in described):
        if asked.remove is None:
            return _measure_all(job)
        return [keep_region(job.loaded.folder, asked.remove, None)]
    if asked.add is None or asked.remove is not None:
        raise ConfigError("give --add NAME with what the region is, or --remove NAME alone")
    name, region = check_name(asked.add, job.loaded.measures.regions), _requested(job, asked)
    found = measured_surface(job).measure(region, name)
    path = keep_region(job.loaded.folder, name, region)
    job.say(f"{name}: {found.in_words(job.materials.names, job.scene.scale)}")
    return [path]


def _measure_all(job: Job) -> list[Path]:
    """Write regions.csv (area and abundances of each kept region and of each material, each number with the ends of its
    90 % interval, empty where not determined), regions-spectra.csv (mean and
    standard deviation), and the means as the library regions.sli."""
    table, spectra = job.folder / "regions.csv", job.folder / "regions-spectra.csv"
    job.claim([table, spectra, *envi_library_paths(job.folder / "regions")])
    surface, names, scale = measured_surface(job), job.materials.names, job.scene.scale
    materials = {f"material {name}": OfMaterial(index) for index, name in enumerate(names)}
    found, failed = measure_regions(surface, {**job.loaded.measures.regions, **materials})
    for reason in failed.values():
        job.say(reason)
    factor = None if scale is None else 1e4 * scale.metres_per_unit**2
    columns = ("area_square_units", "area_cm2", *names)
    rows = [["name", *(f"{column}{end}" for column in columns for end in ("", "_low", "_high"))]]
    reasons: dict[str, None] = {}
    for name, one in found.items():
        of_abundances, area = one.probe.interval("abundances"), one.area_interval
        values = np.array([one.area, np.nan if factor is None else one.area * factor, *one.abundances])
        ends = [
            np.array([end, np.nan if factor is None else end * factor, *others])
            for end, others in ((area.low, of_abundances.low), (area.high, of_abundances.high))
        ]
        numbers = np.stack([values, *ends], axis=1).ravel()
        rows.append([name, *(f"{number:.6g}" if np.isfinite(number) else "" for number in numbers)])
        job.say(f"{name}: {one.in_words(names, scale)}")
        reasons |= dict.fromkeys(filter(None, (of_abundances.not_determined, area.not_determined)))
    for reason in reasons:
        job.say(f"intervals that are empty in regions.csv are not determined: {reason}")
    make_folder(job.folder)
    write_file(table, csv_bytes(rows))
    titles = [f"{name} {what}" for name in found for what in ("mean", "standard deviation")]
    values = np.stack([row for one in found.values() for row in (one.mean, one.spread)]).clip(min=0)
    write_spectra_csv(spectra, SpectraTable(job.materials.bands, tuple(titles), values))
    means = np.stack([one.mean for one in found.values()]).astype(np.float32)
    about = f"mean spectra of regions: {job.materials.quantity}, 1 = full scale"
    library = write_envi_library(job.folder / "regions", means, job.materials.bands, tuple(found), about)
    return [table, spectra, *library]


def _requested(job: Job, asked: Regions) -> Region:
    """The region that is asked for: exactly one of box, material, polygon and mask."""
    given = [what for what in (asked.box, asked.material, asked.polygon, asked.mask) if what is not None]
    if len(given) != 1 or (asked.view is not None) != (asked.polygon is not None or asked.mask is not None):
        raise ConfigError("give one of --box, --material, --view with --polygon, and --view with --mask")
    if asked.box is not None:
        first, second = (find_point(job, text) for text in asked.box)
        low, high = np.minimum(first, second).tolist(), np.maximum(first, second).tolist()
        return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    if asked.material is not None:
        names = job.materials.names
        index = find_endmember(asked.material, names)
        if index is not None:
            return OfMaterial(index)
        raise ConfigError(f"no material {asked.material!r}; there are {', '.join(names)}, or numbers from 0")
    assert asked.view is not None
    camera = find_view(job.views("eval"), asked.view, job.views("train")).camera
    if asked.polygon is not None:
        return InView.of_mask(camera, polygon_mask(_corners(asked.polygon), camera.size(0)))
    assert asked.mask is not None
    return InView.of_mask(camera, _read_mask(asked.mask, camera.size(0)))


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


def set_scale(job: Job, asked: scene_products.Scale) -> list[Path]:
    """Keep the scale of a run, or say what is kept where nothing is given."""
    points, distance_m, metres_per_unit = asked.points, asked.distance, asked.metres_per_unit
    if points is None and distance_m is None and metres_per_unit is None:
        job.say(describe_scale(job.loaded.scale))
        return []
    if metres_per_unit is not None:
        if points is not None or distance_m is not None:
            raise ConfigError("give --points and --distance, or --metres-per-unit alone")
        scale = Scale(metres_per_unit, "as set by --metres-per-unit")
    elif points is None or distance_m is None:
        raise ConfigError("give both, --points and the --distance between them")
    else:
        first, second = (find_point(job, text) for text in points)
        scale = scale_between(first, second, distance_m)
        for point in (first, second):
            require_on_surface(job.loaded.scene, point)
    job.say(scale.in_words)
    return [keep_scale(job.loaded.folder, scale)]


def find_point(job: Job, text: str) -> tuple[float, float, float]:
    """A point of the world: three numbers, or what a view shows in a pixel (VIEW:column,row).

    Raises:
        ConfigError: neither, or the view shows nothing there.
    """
    parts = re.split(r"[\s,]+", text.strip().strip("()"))
    try:
        x, y, z = (float(part) for part in parts)
    except ValueError:
        return _seen_point(job, text)
    if not all(abs(value) < float("inf") for value in (x, y, z)):
        raise ConfigError(f"the point {text} is not finite")
    return x, y, z


def _seen_point(job: Job, text: str) -> tuple[float, float, float]:
    match = re.fullmatch(r"(.+):\s*(\d+)\s*,\s*(\d+)\s*", text)
    if match is None:
        raise ConfigError(
            f"{text!r} is no point: expected x y z in the world, such as '0.1 0.2 0.5', or a pixel of a view as "
            "VIEW:column,row, such as eval_002:120,80"
        )
    view = find_view(job.views("eval"), match[1], job.views("train"))
    found = job.loaded.scene.probe(view.camera, int(match[2]), int(match[3]))
    if found.world_position is None or found.opacity < OCCUPIED_ACCUMULATION:
        raise ConfigError(f"{text}: the view shows nothing there; choose a pixel on the object")
    x, y, z = found.world_position.tolist()
    return x, y, z
