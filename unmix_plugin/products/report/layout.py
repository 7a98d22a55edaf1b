"""The report's sections put together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.engine.runs.load_run import LoadedModel
from unmix_plugin.figures.html_page import Section, paragraph, render_page
from unmix_plugin.formats.files import write_file
from unmix_plugin.products.report.materials import materials_section
from unmix_plugin.products.report.pictures import (
    abundances_section,
    error_section,
    segmentation_section,
    views_section,
    worst_section,
)
from unmix_plugin.products.report.report import report_path
from unmix_plugin.products.report.run import (
    figures_section,
    scene_name,
    scene_section,
    settings_section,
    training_section,
    versions_section,
)
from unmix_plugin.products.report.views import ReportViews
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.trained.evaluation import finite_or_none
from unmix_plugin.trained.library_matches import light_of


def write_report(
    folder: Path,
    loaded: LoadedModel,
    views: ReportViews,
    library: MaterialLibrary,
    stored_figures: dict[str, Any] | None,
    notes: Sequence[str],
) -> Path:
    """Write `report.html`.

    Args:
        folder: Where to write; it is made.
        loaded: The run.
        views: All views that are to be shown have been added.
        library: Known materials.
        stored_figures: What `eval/metrics.json` has; None without it: then those of `views`, if the truth was at hand.
        notes: What a reader has to know first.
    Raises:
        RunError: the disk is full or refuses.
    """
    materials = views.materials
    values, source = stored_figures, "From the run's eval/metrics.json."
    if values is None and views.evaluation is not None:
        values = finite_or_none(views.evaluation.figures())
        source = f"Of the {len(views.shown)} views rendered for this report."
    light = light_of(loaded.model)
    sections = [
        scene_section(loaded, materials, values),
        views_section(views),
        materials_section(materials, views.proportions, light, library, _true_materials(loaded)),
        abundances_section(views),
        segmentation_section(views),
        figures_section(values, source),
        error_section(views),
        worst_section(views),
        training_section(loaded),
        settings_section(loaded),
        versions_section(loaded, ()),
    ]
    shown = [section for section in sections if section is not None]
    if notes:
        warnings = "".join(paragraph(note, "warning") for note in notes)
        shown[0] = Section(shown[0].key, shown[0].title, warnings + shown[0].html)
    title = f"{scene_name(loaded)}: spectral unmixing report"
    subtitle = f"{loaded.config.method_name}, run {loaded.run.path.name}"
    return write_file(report_path(folder), render_page(title, subtitle, shown).encode())


def _true_materials(loaded: LoadedModel) -> tuple[list[str], np.ndarray] | None:
    """Names and radiance of the true materials in the light of the model, as far as the run knows them."""
    summary = loaded.scene.summary
    if not summary.get("endmembers"):
        return None
    reflectance = np.array(summary["endmembers"], dtype=np.float64)
    light = light_of(loaded.model)
    names = summary.get("material_names") or [f"material {index}" for index in range(len(reflectance))]
    return [str(name) for name in names], reflectance if light is None else reflectance * light
