"""The report as one HTML file that holds everything it shows: no script, no font, no request."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from unmix_plugin.figures.plotting import LineChart, css_colour, draw_chart
from unmix_plugin.formats.files import write_file
from unmix_plugin.products.abundances import SHARE_SCALE
from unmix_plugin.products.report import pictures
from unmix_plugin.products.report import report as run
from unmix_plugin.products.report.pictures import (
    ERROR_SCALE,
    ReportViews,
    TrueMaterials,
    evenly,
    material_cards,
)
from unmix_plugin.products.report.report import report_path
from unmix_plugin.spectral.colour.conversion import describe_colour
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.trained.evaluation import finite_or_none
from unmix_plugin.trained.open_run import LoadedRun
from unmix_plugin.trained.run_materials import LIGHT_UNKNOWN

_WORST_VIEWS = 3


def write_report(
    folder: Path,
    loaded: LoadedRun,
    views: ReportViews,
    library: MaterialLibrary,
    stored_figures: dict[str, Any] | None,
    notes: Sequence[str],
) -> Path:
    """Write `report.html`.

    Args:
        folder: Where to write; it is made.
        loaded: The run.
        views: What was rendered.
        library: Known materials.
        stored_figures: What `eval/metrics.json` has; None: those of `views`, if they were compared with measured ones.
        notes: What a reader has to know first.
    Raises:
        RunError: the disk is full or refuses.
    """
    materials, light = views.materials, loaded.materials_scene.light_power
    figures, source = stored_figures, "From the run's eval/metrics.json."
    if figures is None and views.evaluation is not None:
        figures = finite_or_none(views.evaluation.figures())
        source = f"Of the {len(views.shown)} views rendered for this report."
    truth = _true_materials(loaded, light)
    page = render_page(
        {
            "title": f"{run.scene_name(loaded)}: spectral unmixing report",
            "subtitle": f"{loaded.config.method_name}, run {loaded.folder.path.name}",
            "notes": notes,
            "facts": run.scene_facts(loaded, materials, figures),
            "cards": material_cards(materials, views.proportions, light, library, truth),
            "num_known": len(library.names),
            "light_unknown": LIGHT_UNKNOWN if light is None else None,
            "figures": None if figures is None else run.figure_rows(figures),
            "figures_source": source,
            "training": run.training_charts(loaded.folder.metrics_path),
            "settings": run.settings_text(loaded),
            "versions": run.version_rows(loaded),
            **view_values(views),
        }
    )
    return write_file(report_path(folder), page.encode())


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
        "share_scale": (SHARE_SCALE, pictures.scale_strip(SHARE_SCALE)),
        "error_scale": (ERROR_SCALE, pictures.scale_strip(ERROR_SCALE)),
        "segmentation": pictures.segmentation_pictures(views),
        "error_chart": pictures.error_chart(views),
    }


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
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("unmix_plugin.products.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {"css": css_colour, "png": png_url, "svg": _svg_url}
    return environment.get_template("report.html").render(values)


def png_url(image: Float[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 3"]) -> str:
    """An sRGB picture, in [0, 1] or 8-bit, as a URL with the picture in it; large ones are shrunk."""
    from PIL import Image

    is_float = np.issubdtype(image.dtype, np.floating)
    pixels = Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8) if is_float else image)
    longest = max(pixels.size)
    if longest > _LARGEST_SIDE_PX:
        size = [max(1, round(side * _LARGEST_SIDE_PX / longest)) for side in pixels.size]
        pixels = pixels.resize((size[0], size[1]), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    pixels.save(buffer, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _svg_url(chart: LineChart) -> str:
    """A chart as a URL with the drawing in it."""
    return f"data:image/svg+xml;base64,{base64.b64encode(draw_chart(chart)).decode()}"
