"""One HTML file about a run: everything that it learnt and how well, to read, to send or to print. It holds all that it
shows: no script, no font, no request."""

from __future__ import annotations

import base64
import json
import os
import platform
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timezone
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from unmix_plugin import __version__
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.run_json import read_plain_json, read_run_json, write_run_json
from unmix_plugin.errors import ConfigError, RunError, counted
from unmix_plugin.figures.paint import scale_strip
from unmix_plugin.figures.plotting import SpectraChart, css_colour, draw_chart
from unmix_plugin.formats.files import write_file
from unmix_plugin.formats.html import fill_template, picture_url
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.product import Job
from unmix_plugin.products.regions import measure_regions, measured_surface
from unmix_plugin.products.report import pictures
from unmix_plugin.products.report.pictures import (
    ERROR_SCALE,
    ReportViews,
    TrueMaterials,
    evenly,
    material_cards,
)
from unmix_plugin.products.scene_products import Report
from unmix_plugin.products.views import SHARE_SCALE
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.colour.conversion import describe_colour
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.alignment import render_aligned
from unmix_plugin.trained.evaluation import DEFINITIONS, Evaluation, finite_or_none, scene_truth, view_truth
from unmix_plugin.trained.measures import describe_length
from unmix_plugin.trained.open_run import LoadedRun
from unmix_plugin.trained.run_materials import LIGHT_UNKNOWN
from unmix_plugin.trained.run_views import RunView, world_frame
from unmix_plugin.trained.unexplained import describe_unexplained
from unmix_plugin.trained.view_fit import describe_misfits, read_misfits

_VIEWS_WITH_SHARES, _WORST_VIEWS = 2, 3


def export(job: Job, asked: Report) -> list[Path]:
    """Render, compare and lay out."""
    if asked.max_views < 1:
        raise ConfigError(f"--max-views is {asked.max_views}; choose at least 1")
    job.claim([job.folder / "report.html"])
    known = library_of(asked.library, job.materials.bands, job.scene.light_power)
    about = _about(job.loaded.folder, asked)
    chosen = evenly(job.views("eval"), asked.max_views)
    scene, notes = None, []
    if asked.edits is not None or asked.illuminant is not None:
        notes.append(
            "Edited: what is rendered here is the run with the edits or the light asked for; figures and training "
            "are those of the run itself."
        )
    else:
        scene = job.measured_scene(asked.data)
    views = compared_views(job, chosen, scene)
    if len(chosen) < len(job.loaded.record.eval_cameras):
        notes.append(f"Rendered: {len(chosen)} of {len(job.loaded.record.eval_cameras)} evaluation views.")
    run = job.loaded.folder.path
    notes += [
        f"{sentence}." for sentence in [*describe_misfits(read_misfits(run)), *describe_unexplained(run)]
    ]
    with job.working("looking for what no material explains"):
        unexplained = pictures.unexplained_pictures(job.scene, chosen)
    regions, kept = [], job.loaded.measures.regions
    if kept:
        found, failed = measure_regions(measured_surface(job), kept)
        notes += [f"Not shown: {reason}." for reason in failed.values()]
        scale = job.scene.scale
        regions = [pictures.region_card(name, one, job.materials, scale) for name, one in found.items()]
    with job.working("laying out the report"):
        values = {**_page(job, views, known, about), "notes": notes, "regions": regions}
        values["unexplained"], scale = unexplained or ([], None)
        values["unexplained_scale"] = None if scale is None else (scale, scale_strip(scale, 220, 12))
        page = render_page(values).encode("utf-8", "backslashreplace")
        return [write_file(job.folder / "report.html", page)]


def compared_views(job: Job, chosen: Sequence[RunView], scene: Scene | None) -> ReportViews:
    """Render the views, and compare each with what was measured, if the scene folder is found and unchanged; aligned
    first, as unmix-eval does."""
    materials, evaluation = job.materials, None
    if scene is not None:
        evaluation = Evaluation(scene_truth(scene), materials.endmembers, materials.names)
    views = ReportViews(materials, evaluation, {view.name for view in evenly(chosen, _VIEWS_WITH_SHARES)})
    for view in job.follow("rendering views", chosen):
        predicted = truth = None
        if scene is not None:
            index = [frame.name for frame in scene.frames].index(view.name)
            truth = view_truth(scene, index)
            if truth.sensor is None:  # of a rig, only views with all bands are put beside the prediction
                predicted = render_aligned(job.scene, view.camera, scene, index, truth)
        if predicted is None:
            predicted, truth = job.render(view), None
        views.add(view.name, predicted, truth)
    return views


def _stored_figures(job: Job) -> dict[str, Any] | None:
    """What `unmix-eval` found, if it was run."""
    path, figure = job.loaded.folder.eval / "metrics.json", (int, float, type(None))
    try:
        found = read_plain_json(path)
    except FileNotFoundError:
        return None
    words = found.get("definitions", {}) if isinstance(found, dict) else None
    if not isinstance(words, dict) or not all(isinstance(found.get(name), figure) for name in DEFINITIONS):
        raise RunError(f"{path} is not what unmix-eval writes; run it again, or remove the file")
    if found.get("train_seconds") not in (None, job.loaded.training.train_seconds):
        job.say(f"{path} is of an earlier state of the run, and left out; run unmix-eval again")
        return None
    return found


def _page(job: Job, views: ReportViews, library: MaterialLibrary, about: Mapping[str, str]) -> dict[str, Any]:
    """What the report says; with the figures that `unmix-eval` stored, or else those of `views` that were compared."""
    loaded, materials, light = job.loaded, views.materials, job.scene.light_power
    figures, source = _stored_figures(job), "From the run's eval/metrics.json."
    if figures is None and views.evaluation is not None:
        figures = finite_or_none(views.evaluation.figures())
        fitted = {"pose": "pose", "gain": "exposure and white balance"}
        words = " and ".join(fitted[what] for what in job.scene.fitted)
        aligned = f", each aligned first in {words}" if words else ""
        source = f"Of the {len(views.shown)} views rendered for this report{aligned}."
    truth = _true_materials(loaded, light)
    cards = material_cards(materials, views.proportions, light, library, truth)
    unknown = [name for name in DEFINITIONS if figures is not None and figures.get(name, 0) is None]
    rows = figure_rows(figures or {})
    return {
        "title": about.get("title") or f"{loaded.scene_name}: materials and spectra",
        "subtitle": f"{loaded.config.method_name}, run {loaded.folder.path.name}",
        "page": _page_link(job.folder, loaded),
        "summary": _summary(loaded, views, cards, figures, library.names),
        "about": about.get("notes", ""),
        "facts": _scene_facts(loaded, materials, about),
        "cards": cards,
        "quantity": materials.quantity,
        "num_known": len(library.names),
        "light_unknown": None if materials.is_light_known else LIGHT_UNKNOWN,
        "figures": None if figures is None else rows,
        "num_main": sum(name in _MAIN_FIGURES for name, *_ in rows),
        "unknown": unknown,
        "figures_source": source,
        "settings": json.dumps(config_to_json(replace(loaded.config, load_run=None)), indent=1),
        "versions": _version_rows(loaded),
        **view_values(views),
    }


def view_values(views: ReportViews) -> dict[str, Any]:
    """What the template shows of views."""
    shown, worst = evenly(views.shown, pictures.SHOWN_VIEWS), views.worst_first
    colour = describe_colour(views.materials.bands)
    return {
        "colour_note": colour[0].upper() + colour[1:],
        "views": pictures.colour_pictures(shown),
        "is_compared": any(view.measured is not None for view in shown),
        "worst": pictures.colour_pictures(worst[:_WORST_VIEWS]),
        "num_worst": min(len(worst), _WORST_VIEWS),
        "num_compared": len(worst),
        "best_psnr_db": worst[-1].psnr_db if worst else None,
        "shares": pictures.share_pictures(views),
        "share_columns": pictures.map_columns(len(views.materials.names)),
        "share_scale": (SHARE_SCALE, scale_strip(SHARE_SCALE, 220, 12)),
        "error_scale": (ERROR_SCALE, scale_strip(ERROR_SCALE, 220, 12)),
        "segmentation": pictures.segmentation_section(views),
        "error_chart": pictures.error_chart(views),
    }


def _page_link(folder: Path, loaded: LoadedRun) -> str | None:
    """The exported 3-D page from the report's folder as a URL, where there is one on the same drive."""
    page = loaded.folder.exports / "page" / "page.html"
    try:
        return quote(Path(os.path.relpath(page, folder)).as_posix()) if page.is_file() else None
    except ValueError:  # Windows has no way from one drive to another
        return None


def _true_materials(loaded: LoadedRun, light: np.ndarray | None) -> TrueMaterials | None:
    summary = loaded.record.summary
    if not summary.get("endmembers"):
        return None
    reflectance = np.array(summary["endmembers"], dtype=np.float64)
    names = summary.get("material_names") or [f"material {index}" for index in range(len(reflectance))]
    return TrueMaterials([str(name) for name in names], reflectance if light is None else reflectance * light)


_LARGEST_SIDE_PX = 640
"""Larger pictures are shrunk, as a page would show them."""


def render_page(values: Mapping[str, Any]) -> str:
    """The template filled in; text is escaped."""

    def svg_url(chart: SpectraChart) -> str:
        return f"data:image/svg+xml;base64,{base64.b64encode(draw_chart(chart)).decode()}"

    filters = {
        "css": css_colour,
        "png": partial(picture_url, largest_side_px=_LARGEST_SIDE_PX),
        "svg": svg_url,
    }
    return fill_template("unmix_plugin.products.report", "report.html", values, filters)


_PACKAGES = ("torch", "warp-lang", "numpy", "scipy", "scikit-image", "colour-science", "matplotlib", "pillow")
_MAIN_FIGURES = ("psnr", "sam", "rmse", "miou", "accuracy", "abundance_rmse", "endmember_angle")
_NAMED_MATERIALS = 4
_LONGEST_ABOUT = 20_000


def _scene_facts(loaded: LoadedRun, materials: Materials, about: Mapping[str, str]) -> list[tuple[str, str]]:
    """What the report is of, in a few words."""
    scene, world = loaded.record, loaded.materials_scene
    size = (scene.scene_box.size.cpu().double().numpy() / world_frame(scene).scale).tolist()
    cameras = scene.train_cameras
    sizes = sorted({cameras.size(index) for index in range(len(cameras))}, reverse=True)
    light = "taken out: values are reflectance" if materials.quantity == "reflectance" else "recorded"
    named = [(word.capitalize(), about[word]) for word in ("object", "number", "author") if about.get(word)]
    return [
        *named,
        ("Scene", loaded.scene_name),
        ("Views", f"{len(cameras)} to learn from, {len(scene.eval_cameras)} to check with"),
        ("Pixels of a view", ", ".join(f"{width} x {height}" for width, height in sizes)),
        ("Bands", str(materials.bands)),
        ("Light", light if materials.is_light_known else "unknown, taken as flat"),
        ("Box that holds the scene", " x ".join(describe_length(edge, world.scale) for edge in size)),
        *([("Scale", world.scale.in_words)] if world.scale is not None else []),
        ("Training", f"{loaded.training.train_seconds:,.0f} s"),
    ]


def _summary(
    loaded: LoadedRun,
    views: ReportViews,
    cards: Sequence[Mapping[str, Any]],
    figures: Mapping[str, Any] | None,
    known_names: Collection[str],
) -> str:
    """What was found and how sure, in two or three sentences."""
    named, ordered = [], sorted(cards, key=lambda card: -card["proportion"])
    for card in ordered[:_NAMED_MATERIALS]:
        labels = [line.label for line, *_ in card["matches"] if line.label in known_names]
        near = [f", most like {label}" for label in labels]
        named.append(f"{card['name']} ({card['proportion']:.0%} of what is seen{''.join(near[:1])})")
    if len(ordered) > _NAMED_MATERIALS:
        named.append(f"and {len(ordered) - _NAMED_MATERIALS} more")
    count, known = len(loaded.record.train_cameras), figures or {}
    text = f"{counted(len(cards), 'material')} told apart in {counted(count, 'view')}: {', '.join(named)}."
    words = (("sam", "spectra are off by", " rad"), ("rmse", "values by", " of full scale"))
    errors = [
        f"{phrase} {known[name]:.2g}{unit}" for name, phrase, unit in words if known.get(name) is not None
    ]
    if errors:
        text += f" In views that were kept apart from training, {' and '.join(errors)}, on average."
    if views.confidence is not None:
        text += f" A pixel's main material is right with an estimated probability of {views.confidence:.0%} on average."
    return text if errors else f"{text} Not compared with measured views."


def _about(run: RunFolder, asked: Report) -> dict[str, str]:
    """Title, author, object, number and notes: what is given now, beside what the run keeps from before."""
    path, kept = run.path / "report.json", {}
    given = {name: getattr(asked, name) for name in ("title", "author", "object", "number", "notes")}
    if path.exists():
        kept = {name: read_run_json(path).get(name) or "" for name in given}
        if not all(isinstance(text, str) for text in kept.values()):
            raise RunError(f"{path} is damaged: it should hold texts; remove it")
    about = {name: kept.get(name, "") if text is None else text for name, text in given.items()}
    too_long = [name for name, text in about.items() if len(text) > _LONGEST_ABOUT]
    if too_long:
        raise ConfigError(f"--{too_long[0]} is longer than {_LONGEST_ABOUT} letters")
    if about != kept and any(text is not None for text in given.values()):
        write_run_json(path, dict(about))
    return about


def figure_rows(values: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Each figure of merit that is known, as `eval/metrics.json` has it, with its definition; the main ones first."""
    definitions = {**DEFINITIONS, **(values.get("definitions") or {})}
    return [
        (name, f"{values[name]:.4g}", definitions[name])
        for name in dict.fromkeys((*_MAIN_FIGURES, *DEFINITIONS))
        if values.get(name) is not None
    ]


def _version_rows(loaded: LoadedRun) -> list[tuple[str, str]]:
    """What made this report, of what."""
    hashes = loaded.record.summary.get("input_hashes") or {}
    rows = [
        ("run", str(loaded.folder.path)),
        ("scene", str(loaded.record.summary.get("root", "unknown"))),
        ("input files", f"{len(hashes)}, with their SHA-256 in the run's scene.json"),
        ("report made", f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"),
        ("unmix-nerf", __version__),
        ("Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
    ]
    for name in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            rows.append((name, metadata.version(name)))
    return rows
