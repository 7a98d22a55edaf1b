"""The spectrum of a place as files: a table, a plot, and what it is made of.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from unmix_plugin.editing.recipe_files import read_recipe
from unmix_plugin.engine.printing import plot_text
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.plotting import figure_bytes, mark_lone_points, plain_axes
from unmix_plugin.formats.envi import envi_library_paths, write_envi_library
from unmix_plugin.formats.files import NOT_PORTABLE, make_folder, safe_name, write_file
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.product import Job
from unmix_plugin.products.regions import measured_surface
from unmix_plugin.products.scene_products import Spectrum
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.trained.measures import describe_scale
from unmix_plugin.trained.places import (
    MeasuredScene,
    MeasuredSpectra,
    NamedRegion,
    Pixel,
    PlaceSpectrum,
    Point,
    SeenPixel,
    spectrum_at,
)
from unmix_plugin.trained.protocol import Probe
from unmix_plugin.trained.run_materials import (
    LIGHT_UNKNOWN,
    ShownMatch,
    endmember_colours,
    match_json,
    shown_matches,
)
from unmix_plugin.trained.run_views import RunView, find_view
from unmix_plugin.trained.trained_scene import TrainedScene

_MOST_BARS = 12


def export(job: Job, asked: Spectrum) -> list[Path]:
    """Probe a place and write what is there."""
    place = _asked_place(job, asked)
    materials, light, probe = job.materials, job.scene.light_power, place.probe
    known = library_of(asked.library, materials.bands, light)
    if not materials.is_light_known:
        job.say(LIGHT_UNKNOWN)
    if probe.opacity < OCCUPIED_ACCUMULATION:
        job.say(f"hardly anything is there: opacity {probe.opacity:.2f}")
    else:
        spectra = probe.spectra["predicted"][None]
        [matches] = shown_matches(spectra, materials.bands, light, known, asked.compare)
        place = replace(place, matches=matches)
    if asked.edits is not None and read_recipe(asked.edits).operations:
        place = replace(place, unedited=" before the edits")
    written = _write_spectrum(job.folder, place, job.scene)
    if place.spread is not None:
        mean = probe.spectra["predicted"][None].astype(np.float32)
        about = f"mean spectrum: {materials.quantity}, 1 = full scale"
        base = job.folder / place.name
        written += write_envi_library(base, mean, materials.bands, (place.title,), about)
    return written


def _asked_place(job: Job, asked: Spectrum) -> ProbedPlace:
    """What is at the place asked for: exactly one of a pixel, a point and a region."""
    given = (
        asked.view is not None,
        asked.pixel is not None,
        asked.point is not None,
        asked.region is not None,
    )
    if given == (False, False, False, True):
        return _region(job, str(asked.region))
    if given == (False, False, True, False):
        point = _numbers(str(asked.point))
        name = f"point_{'_'.join(f'{value:g}' for value in point)}"
        job.claim(_spectrum_paths(job.folder, name))
        found = _spectrum_at(job, Point(*point), _measured_scene(job, asked))
        title = f"point {', '.join(f'{value:g}' for value in point)}"
        return ProbedPlace(name, title, {"point": list(point)}, found.probe, over_views=found.measured)
    if given != (True, True, False, False):
        raise ConfigError(
            "give a pixel with --view and --pixel, a point with --point, or a region with --region alone"
        )
    match = re.fullmatch(r"\s*(\d+)\s*,\s*(\d+)\s*", str(asked.pixel))
    if match is None:
        raise ConfigError(f"--pixel {asked.pixel} is not a column and a row from 0, such as 120,80")
    column, row = int(match[1]), int(match[2])
    view = find_view(job.views("eval"), str(asked.view), job.views("train"))
    name = f"{view.name}_x{column}_y{row}"
    job.claim(_spectrum_paths(job.folder, name))
    measured = _measured_scene(job, asked)
    found = _spectrum_at(job, Pixel(view.camera, column, row), measured)
    title, facts = f"{view.name}, column {column}, row {row}", {"view": view.name, "pixel": [column, row]}
    own = _of_pixel(job, measured, view, column, row)
    return ProbedPlace(name, title, facts, found.probe, own, over_views=found.measured)


def _measured_scene(job: Job, asked: Spectrum) -> MeasuredScene | None:
    scene = job.measured_scene(asked.data)
    return None if scene is None else MeasuredScene(scene, job.loaded.record.summary.get("illuminant"))


def _spectrum_at(job: Job, place: Pixel | Point, measured: MeasuredScene | None) -> PlaceSpectrum:
    with job.working("looking at the place"):
        found = spectrum_at(job.scene, place, measured)
    if measured is not None and (found.measured is None or len(found.measured.views) < 2):
        job.say("fewer than two training views see the place: no spread over views")
    return found


def _region(job: Job, region: str) -> ProbedPlace:
    name, kept = safe_name(f"region_{region}", NOT_PORTABLE), job.loaded.measures.region(region)
    job.claim([*_spectrum_paths(job.folder, name), *envi_library_paths(job.folder / name)])
    found = spectrum_at(job.scene, NamedRegion(region, kept, measured_surface(job)))
    assert found.region is not None
    job.say(f"{region}: {found.region.in_words(job.materials.names, job.scene.scale)}")
    facts = {"region": region, "area_square_units": found.region.area}
    return ProbedPlace(name, f"region {region}", facts, found.probe, spread=found.region.spread)


def _of_pixel(
    job: Job, measured: MeasuredScene | None, view: RunView, column: int, row: int
) -> Float64[np.ndarray, " B"] | None:
    """What the view itself measured in a pixel, in the light asked for; None, which is said, where it did not."""
    if measured is None:
        return None
    scene, training = measured.scene, measured.scene.train_indices
    pixel = SeenPixel([frame.name for frame in scene.frames].index(view.name), column, row)
    if not scene.sensor_of(pixel.view).sees_all_bands:
        job.say(f"{view.name} was taken by a sensor without all bands: no measured spectrum")
        return None
    if not measured.counts(pixel):
        job.say(
            f"{view.name} has no valid value in that pixel, or its mask leaves it out: no measured spectrum"
        )
        return None
    if job.scene.view_gains is not None and pixel.view not in training:
        job.say(f"no exposure was fitted to {view.name}: what it measured is as it was exposed")
    return measured.spectrum(pixel, job.scene)


@dataclass(frozen=True)
class ProbedPlace:
    """A place, and all that is known of it."""

    name: str
    """Of its files."""
    title: str
    """For people."""
    facts: dict[str, Any]
    """Where it is, as JSON has it."""
    probe: Probe
    measured: Float[np.ndarray, " B"] | None = None
    """Spectrum that the scene has there, in the light of the prediction."""
    matches: Sequence[ShownMatch] = ()
    """Known materials that the predicted spectrum resembles, nearest first; none where nothing is."""
    spread: Float[np.ndarray, " B"] | None = None
    """Standard deviation, of a region."""
    over_views: MeasuredSpectra | None = None
    """What training views measured there, in the light of the prediction."""
    unedited: str = ""
    """Words for what was measured, where the prediction is of edited materials."""


def _spectrum_paths(folder: Path, name: str) -> list[Path]:
    return [folder / f"{name}.{kind}" for kind in ("csv", "json", "png")]


def _write_spectrum(folder: Path, place: ProbedPlace, scene: TrainedScene) -> list[Path]:
    """Write NAME.csv (`wavelength,predicted,...`, `measured` and mean and standard deviation over views where they are
    known), NAME.json (where the place is, its opacity, abundances and nearest known materials) and NAME.png, a plot.
    """
    materials = scene.materials
    table_path, facts_path, plot_path = _spectrum_paths(make_folder(folder), place.name)
    columns = dict(place.probe.spectra)
    if place.measured is not None:
        columns[f"measured{place.unedited}"] = place.measured.astype(np.float64)
    if place.over_views is not None:
        columns[f"mean over views{place.unedited}"] = place.over_views.mean
        if place.over_views.spread is not None:
            columns[f"standard deviation over views{place.unedited}"] = place.over_views.spread
    if place.spread is not None:
        columns = {"mean": columns["predicted"].clip(min=0), "standard deviation": place.spread}
    interval = place.probe.interval("predicted")
    if interval.is_known:
        name = "predicted" if place.spread is None else "mean"
        columns |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
    values = np.stack(list(columns.values()))
    write_spectra_csv(table_path, SpectraTable(materials.bands, tuple(columns), values))
    facts = {**place_facts(place, materials), "scale": describe_scale(scene.scale)}
    write_file(facts_path, (json.dumps(facts, indent=1, allow_nan=False) + "\n").encode())
    return [table_path, facts_path, write_file(plot_path, _draw_spectrum(place, materials))]


def _draw_spectrum(place: ProbedPlace, materials: Materials) -> bytes:
    """The spectra over wavelength, and the abundances beside them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 4.4), layout="constrained", facecolor="white")
    lines, bars = figure.subplots(1, 2, width_ratios=[2.4, 1])
    wavelengths = materials.bands.centers_nm
    if place.measured is not None:
        lines.plot(
            wavelengths, place.measured, color="0.55", linewidth=3.5, label=f"measured{place.unedited}"
        )
    lines.plot(wavelengths, place.probe.spectra["predicted"], color="black", linewidth=1.8, label="predicted")
    mean, spread, label = place.probe.spectra["predicted"], place.spread, "± 1 std. dev."
    if place.over_views is not None:
        mean, spread = place.over_views.mean, place.over_views.spread
        label = f"{len(place.over_views.views)} training views{place.unedited}, ± 1 std. dev."
    interval = place.probe.interval("predicted")
    if interval.is_known:
        lines.fill_between(
            wavelengths,
            interval.low,
            interval.high,
            color="C0",
            alpha=0.2,
            linewidth=0,
            label="90 % interval",
        )
    if spread is not None:
        lines.fill_between(wavelengths, mean - spread, mean + spread, color="0.85", label=label)
    for style, shown in zip(("--", "-.", ":"), place.matches, strict=False):
        label = plot_text(f"{shown.match.name} ({shown.match.angle_rad:.3f} rad)")
        lines.plot(wavelengths, shown.spectrum, linestyle=style, linewidth=1.3, label=label)
    mark_lone_points(lines)
    lines.set(xlabel="wavelength (nm)", ylabel=f"{materials.quantity} (1 = full scale)")
    lines.set_ylim(bottom=0.0)
    lines.set_title(plot_text(place.title), loc="left", fontweight="bold")
    lines.legend(frameon=False)
    plain_axes(lines)
    _draw_abundances(bars, place.probe, materials)
    plain_axes(bars)
    return figure_bytes(figure)


def _draw_abundances(axes: Any, probe: Probe, materials: Materials) -> None:
    """The largest abundances as bars, the largest on top."""
    chosen = np.argsort(-probe.abundances, kind="stable")[:_MOST_BARS]
    colours = endmember_colours(materials)
    interval = probe.interval("abundances")
    reach = None
    if interval.is_known:
        reach = np.stack([probe.abundances - interval.low, interval.high - probe.abundances]).clip(min=0)[
            :, chosen
        ]
    axes.barh(
        range(len(chosen)),
        probe.abundances[chosen],
        xerr=reach,
        ecolor="0.2",
        color=[tuple(colours[index]) for index in chosen],
        edgecolor="0.3",
        linewidth=0.6,
    )
    axes.set_yticks(range(len(chosen)), [plot_text(materials.names[index]) for index in chosen])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("abundance")
    axes.set_title(f"opacity {probe.opacity:.2f}", loc="left")


def place_facts(place: ProbedPlace, materials: Materials) -> dict[str, Any]:
    probe = place.probe
    is_something = probe.opacity >= OCCUPIED_ACCUMULATION
    shares = dict(zip(materials.names, probe.abundances.tolist(), strict=True))
    interval = probe.interval("abundances")
    ends = {
        f"abundances_{end}": {
            name: value if math.isfinite(value) else None
            for name, value in zip(materials.names, values, strict=True)
        }
        if interval.is_known
        else None
        for end, values in (("low", interval.low.tolist()), ("high", interval.high.tolist()))
    }
    position = probe.world_position
    return {
        **place.facts,
        "world_position": None if position is None else position.tolist(),
        "opacity": probe.opacity,
        "measured_in_views": None if place.over_views is None else len(place.over_views.views),
        "material": materials.name_of(probe.spectra["predicted"], probe.abundances) if is_something else None,
        "abundances": shares,
        **ends,
        "interval": {"coverage": interval.coverage, "not_determined": interval.not_determined or None},
        "library": [match_json(shown.match) for shown in place.matches],
    }


def _numbers(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) + 0.0 for part in text.split(","))  # no minus before a 0
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise ConfigError(f"--point {text} is not 3 numbers with commas between, such as 0.1,0.2,0.5")
    return x, y, z
