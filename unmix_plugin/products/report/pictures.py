"""Sections of a report that show views: colour, errors, abundances, segmentations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import UInt8

from unmix_plugin.figures.html_page import (
    Section,
    figure,
    figures,
    paragraph,
    picture,
    swatch,
    table,
)
from unmix_plugin.figures.picture_grid import NEUTRAL, ColourScale, paint
from unmix_plugin.figures.plotting import RIGHT, WRONG, Colour
from unmix_plugin.figures.svg_chart import Chart, Line, draw_chart, draw_legend
from unmix_plugin.products.abundances import SHARE_SCALE
from unmix_plugin.products.evaluation_pictures import MaterialLook, material_look
from unmix_plugin.products.report.views import ERROR_SCALE, ReportViews, ShownView, evenly
from unmix_plugin.products.segmentation import paint_ids
from unmix_plugin.spectral.colour.conversion import describe_colour
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.run_materials import endmember_colours

_SHOWN_VIEWS, _WORST_VIEWS = 3, 3
_MAP_COLUMNS = (7, 6, 5)


def views_section(views: ReportViews) -> Section:
    """Some views in colour: measured, if at hand, predicted, and their difference."""
    chosen = evenly(views.shown, _SHOWN_VIEWS)
    text = describe_colour(views.materials.bands)
    html = paragraph(f"{text[0].upper()}{text[1:]}; light grey where nothing is.", "note")
    if any(view.measured is not None for view in chosen):
        return Section("views", "Views", html + _compared(chosen))
    panels = [figure(_shown(view.predicted, f"{view.name}, predicted"), escape(view.name)) for view in chosen]
    return Section("views", "Views", html + figures(panels, 3))


def worst_section(views: ReportViews) -> Section | None:
    """The views that are predicted worst; none where the truth is not at hand."""
    worst = views.worst_first
    if not worst:
        return None
    html = paragraph(
        f"The {min(len(worst), _WORST_VIEWS)} evaluation views of lowest PSNR of {len(worst)} rendered; "
        f"the best has {worst[-1].psnr_db:.1f} dB."
    )
    return Section("worst", "Worst views", html + _compared(worst[:_WORST_VIEWS]))


def error_section(views: ReportViews) -> Section | None:
    """Error against wavelength; none where the truth is not at hand."""
    if not np.isfinite(views.rmse_of_bands).all():
        return None
    wavelengths = views.materials.bands.centers_nm
    lines = [
        Line(wavelengths, views.rmse_of_bands, "root mean squared error", "#0b5cad"),
        Line(wavelengths, views.bias_of_bands, "mean of predicted less measured", "#c8501e", dashes="6 4"),
    ]
    chart = Chart(
        lines,
        "wavelength (nm)",
        "radiance (1 = full scale)",
        "error of the predicted radiance over wavelength",
        from_zero=True,
        size=(900.0, 300.0),
    )
    html = paragraph(
        "Over all pixels of the rendered evaluation views that are labelled or opaque, predictions clamped to [0, 1]."
    )
    return Section("error", "Error against wavelength", html + draw_chart(chart) + draw_legend(lines))


def abundances_section(views: ReportViews) -> Section:
    """Maps of every endmember in some views."""
    names, colours = views.materials.names, endmember_colours(views.materials)
    blocks = [_bar(SHARE_SCALE)]
    for view in (view for view in views.shown if view.shares):
        panels = [
            figure(_shown(image, f"{view.name}, abundance of {name}"), swatch(colour) + escape(name))
            for image, name, colour in zip(view.shares, names, colours, strict=True)
        ]
        blocks.append(f"<h3>{escape(view.name)}</h3>{figures(panels, _map_columns(len(names)))}")
    return Section("abundances", "Abundances", "".join(blocks))


def segmentation_section(views: ReportViews) -> Section:
    """Materials of some views; against labels where there are some."""
    evaluation = views.evaluation
    chosen = evenly(views.shown, _SHOWN_VIEWS)
    if evaluation is None or not any(view.labels is not None for view in chosen):
        colours = endmember_colours(views.materials)
        panels = [
            figure(
                _shown(paint_ids(view.ids, dict(enumerate(colours))), f"{view.name}, materials"),
                escape(view.name),
            )
            for view in chosen
        ]
        legend = _colour_legend(list(zip(views.materials.names, colours, strict=True)))
        return Section("segmentation", "Segmentation", figures(panels, 3) + legend)
    scores, look = evaluation.segmentation(), material_look(evaluation)
    html = paragraph(
        "Predicted materials in the colours of the true ones that they are matched to, one to one over all rendered "
        "views, by intersection over union."
    )
    panels = [panel for view in chosen for panel in _against_labels(view, look, scores.matching)]
    surplus = [
        (f"{name} (no match)", look.surplus_colours[index])
        for index, name in enumerate(look.pred_names)
        if index not in scores.matching
    ]
    extra: list[tuple[str, Colour]] = [("right", RIGHT), ("wrong", WRONG)]
    html += figures(panels, 3) + _colour_legend([*look.true_entries, *surplus, *extra])
    return Section("segmentation", "Segmentation", html + _iou_table(look, scores.matching, scores.iou))


def _map_columns(count: int) -> int:
    """Columns of a grid of small maps that leave the fewest places empty."""
    if count <= _MAP_COLUMNS[0]:
        return max(count, 4)
    return min(_MAP_COLUMNS, key=lambda columns: -count % columns)


def _compared(views: Sequence[ShownView]) -> str:
    panels: list[str] = []
    for view in views:
        caption = f"{view.name}: " if len(view.name) < 40 else ""
        panels.append(figure(_shown(view.measured, f"{view.name}, measured"), escape(f"{caption}measured")))
        panels.append(figure(_shown(view.predicted, f"{view.name}, predicted"), "predicted"))
        panels.append(
            figure(_shown(view.error, f"{view.name}, error"), escape(f"error, PSNR {view.psnr_db:.1f} dB"))
        )
    return figures(panels, 3) + _bar(ERROR_SCALE)


def _against_labels(view: ShownView, look: MaterialLook, matching: Mapping[int, int]) -> list[str]:
    predicted = paint_ids(view.ids, look.pred_colours(matching))
    labels = view.labels if view.labels is not None else np.full_like(view.ids, NOTHING_ID)
    as_true = np.full(256, NOTHING_ID, dtype=np.uint8)
    as_true[list(matching)] = list(matching.values())
    agreement = np.where((as_true[view.ids] != labels)[..., None], WRONG, RIGHT)
    agreement[labels == NOTHING_ID] = NEUTRAL
    true = paint_ids(labels, dict(enumerate(look.true_colours)))
    return [
        figure(_shown(true, f"{view.name}, labels"), escape(f"{view.name}: labels")),
        figure(_shown(predicted, f"{view.name}, predicted materials"), "predicted"),
        figure(_shown(agreement, f"{view.name}, agreement"), "agreement"),
    ]


def _iou_table(look: MaterialLook, matching: Mapping[int, int], iou: Mapping[int, float]) -> str:
    partners = {true: pred for pred, true in matching.items()}
    rows = [
        [
            swatch(look.true_colours[index]) + escape(name),
            escape(look.pred_names[partners[index]]) if index in partners else "none",
            f"{iou[index]:.3f}" if index in iou else "not in these views",
        ]
        for index, name in enumerate(look.true_names)
    ]
    return table(
        ["material", "endmember", "intersection over union"], rows, numeric=(2,), cells_are_html=True
    )


def _colour_legend(entries: Sequence[tuple[str, Colour]]) -> str:
    keys = "".join(
        f'<span class="key">{swatch(np.asarray(colour))}{escape(name)}</span>' for name, colour in entries
    )
    return f'<div class="legend">{keys}</div>'


def _bar(scale: ColourScale) -> str:
    """What colours mean, as a strip from low to high."""
    strip = paint(np.linspace(scale.low, scale.high, 220)[None], scale)
    image = picture(np.repeat(strip, 12, axis=0), f"colours from {scale.low:g} to {scale.high:g}")
    return f'<div class="bar">{escape(scale.label)}: {scale.low:g} {image} {scale.high:g}</div>'


def _shown(image: UInt8[np.ndarray, "H W 3"] | np.ndarray | None, alternative: str) -> str:
    assert image is not None
    values = image / 255 if image.dtype == np.uint8 else image
    return picture(values, alternative)
