"""Pictures of a report: views in colour, their errors, abundances and segmentations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from unmix_plugin.figures.pictures import NEUTRAL, ColourScale, paint
from unmix_plugin.figures.plotting import RIGHT, WRONG, ChartLine, Colour, LineChart
from unmix_plugin.products.evaluation import MaterialLook, material_look
from unmix_plugin.products.report.views import ReportViews, ShownView, evenly
from unmix_plugin.products.segmentation import paint_ids
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.run_materials import endmember_colours

SHOWN_VIEWS = 3
_MAP_COLUMNS = (7, 6, 5)


@dataclass(frozen=True)
class CaptionedPicture:
    """A picture with a line below it."""

    image: np.ndarray
    """(H, W, 3) sRGB, in [0, 1] or 8-bit."""
    caption: str
    alternative: str
    """What it shows, for those who can't see it."""
    swatch: Colour | None = None


@dataclass(frozen=True)
class ShownSegmentation:
    """Materials of some views; against labels where there are some."""

    pictures: Sequence[CaptionedPicture]
    legend: Sequence[tuple[str, Colour]]
    scores: Sequence[tuple[str, Colour, str, str]] = ()
    """True material, its colour, the endmember that it is matched to, intersection over union."""


def colour_pictures(views: Sequence[ShownView]) -> list[CaptionedPicture]:
    """Each view as measured, as predicted, and their difference; as predicted alone where nothing was measured."""
    pictures: list[CaptionedPicture] = []
    for view in views:
        if view.measured is None or view.error is None:
            pictures.append(CaptionedPicture(view.predicted, view.name, f"{view.name}, predicted"))
            continue
        name = f"{view.name}: " if len(view.name) < 40 else ""
        pictures += [
            CaptionedPicture(view.measured, f"{name}measured", f"{view.name}, measured"),
            CaptionedPicture(view.predicted, "predicted", f"{view.name}, predicted"),
            CaptionedPicture(view.error, f"error, PSNR {view.psnr_db:.1f} dB", f"{view.name}, error"),
        ]
    return pictures


def share_pictures(views: ReportViews) -> list[tuple[str, list[CaptionedPicture]]]:
    """Maps of every endmember in the views chosen for it, by view."""
    colours = endmember_colours(views.materials)
    return [
        (
            view.name,
            [
                CaptionedPicture(image, name, f"{view.name}, abundance of {name}", colour)
                for image, name, colour in zip(view.shares, views.materials.names, colours, strict=True)
            ],
        )
        for view in views.shown
        if view.shares
    ]


def map_columns(count: int) -> int:
    """Columns of a grid of small maps that leave the fewest places empty."""
    if count <= _MAP_COLUMNS[0]:
        return max(count, 4)
    return min(_MAP_COLUMNS, key=lambda columns: -count % columns)


def error_chart(views: ReportViews) -> LineChart | None:
    """Error against wavelength; None without measured views."""
    if not np.isfinite(views.rmse_of_bands).all():
        return None
    nm = views.materials.bands.centers_nm
    lines = [
        ChartLine(nm, views.rmse_of_bands, "root mean squared error", "#0b5cad"),
        ChartLine(nm, views.bias_of_bands, "mean of predicted less measured", "#c8501e", dash="dashed"),
    ]
    return LineChart(
        lines, "wavelength (nm)", "radiance (1 = full scale)", from_zero=True, size=(900.0, 300.0)
    )


def segmentation_pictures(views: ReportViews) -> ShownSegmentation:
    """Materials of some views; against labels where there are some."""
    evaluation = views.evaluation
    chosen = evenly(views.shown, SHOWN_VIEWS)
    if evaluation is None or not any(view.labels is not None for view in chosen):
        colours = endmember_colours(views.materials)
        pictures = [
            CaptionedPicture(
                paint_ids(view.ids, dict(enumerate(colours))), view.name, f"{view.name}, materials"
            )
            for view in chosen
        ]
        return ShownSegmentation(pictures, list(zip(views.materials.names, colours, strict=True)))
    scores, look = evaluation.segmentation(), material_look(evaluation)
    matching = scores.matching
    surplus = [
        (f"{name} (no match)", look.surplus_colours[index])
        for index, name in enumerate(look.pred_names)
        if index not in matching
    ]
    partners = {true: look.pred_names[pred] for pred, true in matching.items()}
    rows = [
        (name, colour, partners.get(index, "none"), f"{iou:.3f}" if iou is not None else "not in these views")
        for index, (name, colour) in enumerate(look.true_entries)
        for iou in [scores.iou.get(index)]
    ]
    pictures = [one for view in chosen for one in _against_labels(view, look, matching)]
    legend = [*look.true_entries, *surplus, ("right", RIGHT), ("wrong", WRONG)]
    return ShownSegmentation(pictures, legend, rows)


def scale_strip(scale: ColourScale) -> np.ndarray:
    """The colours of a scale from low to high, (12, 220, 3)."""
    return np.repeat(paint(np.linspace(scale.low, scale.high, 220)[None], scale), 12, axis=0)


def _against_labels(
    view: ShownView, look: MaterialLook, matching: Mapping[int, int]
) -> list[CaptionedPicture]:
    labels = view.labels if view.labels is not None else np.full_like(view.ids, NOTHING_ID)
    as_true = np.full(256, NOTHING_ID, dtype=np.uint8)
    as_true[list(matching)] = list(matching.values())
    agreement = np.where((as_true[view.ids] != labels)[..., None], WRONG, RIGHT)
    agreement[labels == NOTHING_ID] = NEUTRAL
    predicted = paint_ids(view.ids, look.pred_colours(matching))
    true = paint_ids(labels, dict(enumerate(look.true_colours)))
    return [
        CaptionedPicture(true, f"{view.name}: labels", f"{view.name}, labels"),
        CaptionedPicture(predicted, "predicted", f"{view.name}, predicted materials"),
        CaptionedPicture(agreement, "agreement", f"{view.name}, agreement"),
    ]
