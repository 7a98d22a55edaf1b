"""What a report shows and counts of views and endmembers, fed view by view; keeps small pictures, never spectra.

Cards and sections are dictionaries for the template, report.html, which reads them by their names.

Notation: `H x W` pixels, `B` bands, `K` endmembers, `M` true materials.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from unmix_plugin.engine.outputs import Output
from unmix_plugin.figures.paint import ColourScale, as_bytes, paint, scale_of
from unmix_plugin.figures.plotting import RIGHT, WRONG, ChartLine, Colour, SpectraChart, css_colour
from unmix_plugin.formats.files import eight_bits
from unmix_plugin.products.evaluation import material_look
from unmix_plugin.products.views import SHARE, paint_ids
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.evaluation import Evaluation, PredictedView, ViewTruth, as_numpy, picture
from unmix_plugin.trained.measured_surface import MeasuredRegion
from unmix_plugin.trained.measures import Scale, describe_area
from unmix_plugin.trained.mixture_view import picture_values
from unmix_plugin.trained.run_materials import endmember_colours, shown_matches
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import TrainedScene

SHOWN_VIEWS = 3
_ERROR = Output("error", "map", "error", "root mean squared error over bands", (0.0, 0.1), "magma")
ERROR_SCALE = scale_of(_ERROR)
"""Colours of errors of spectra."""
_UNEXPLAINED_RANGE = (0.0, 0.2)
"""What pictures show of the part that no material explains."""
_MAP_COLUMNS = (7, 6, 5)
_STYLES = (("dashed", "#4b545c"), ("dotted", "#7a838b"), ("solid", "#a2aab1"))
_EightBits = UInt8[np.ndarray, "H W 3"]
_ItemT = TypeVar("_ItemT")


def evenly(items: Sequence[_ItemT], count: int) -> list[_ItemT]:
    """At most `count` of the items, evenly spread, the first and the last among them.

    >>> evenly("abcdefg", 3)
    ['a', 'd', 'g']
    """
    if len(items) <= count:
        return list(items)
    return [items[index] for index in np.linspace(0, len(items) - 1, count).round().astype(int)]


@dataclass(frozen=True)
class _ShownView:
    """A view as pictures, 8-bit sRGB, and ids."""

    name: str
    predicted: _EightBits
    ids: UInt8[np.ndarray, "H W"]
    shares: tuple[_EightBits, ...]
    """One for each endmember, of views chosen for it."""
    measured: _EightBits | None = None
    error: _EightBits | None = None
    labels: UInt8[np.ndarray, "H W"] | None = None
    """True material of pixels that count, 255 elsewhere."""
    psnr_db: float = math.nan


class ReportViews:
    """Pictures of views, and figures over all of them."""

    def __init__(
        self, materials: Materials, evaluation: Evaluation | None, with_shares: Collection[str]
    ) -> None:
        """No evaluation without measured views; `with_shares` are the names of views whose abundances are shown."""
        self.materials = materials
        self.evaluation = evaluation
        self.shown: list[_ShownView] = []
        self._with_shares = frozenset(with_shares)
        self._squares, self._offsets = np.zeros((2, len(materials.bands)))
        self._amounts = np.zeros(len(materials.names))
        self._pixels, self._sure, self._seen = 0, 0.0, 0.0

    def add(self, name: str, view: PredictedView, truth: ViewTruth | None) -> None:
        """Count a view, and make its pictures."""
        self._amounts += as_numpy(view.abundances).sum(axis=(0, 1))
        opacity, bands = as_numpy(view.accumulation), self.materials.bands
        if view.confidence is not None:
            is_seen = view.segmentation.numpy() != NOTHING_ID  # elsewhere nothing is said of a material
            self._sure += float((as_numpy(view.confidence) * opacity)[is_seen].sum())
            self._seen += float(opacity[is_seen].sum())
        maps = view.shares.unbind(dim=-1) if name in self._with_shares else ()
        shares = tuple(as_bytes(paint(SHARE, one, opacity).over()[:, :, 0]) for one in maps)
        spectra = view.spectra if truth is None else truth.shown(view)
        predicted = eight_bits(picture(spectra, view.coverage, bands))
        given = (name, predicted, view.segmentation.numpy(), shares)
        if truth is None or self.evaluation is None:
            self.shown.append(_ShownView(*given))
            return
        psnr_db = self.evaluation.add(truth, view)["psnr"]
        labels = None if truth.counted_labels is None else truth.counted_labels.numpy()
        measured = eight_bits(picture(truth.spectra, truth.opacity, bands))

        difference = as_numpy(truth.shown(view).clamp(0, 1)) - as_numpy(truth.spectra)
        foreground = truth.shows_matter.numpy()
        self._squares += (difference[foreground] ** 2).sum(axis=0)
        self._offsets += difference[foreground].sum(axis=0)
        self._pixels += int(foreground.sum())
        seen = np.maximum(as_numpy(view.coverage), as_numpy(truth.opacity)) > 0.01
        counted = (seen & truth.valid.numpy()).astype(np.float64)
        error = as_bytes(paint(_ERROR, np.sqrt((difference**2).mean(axis=-1)), counted).over()[:, :, 0])
        self.shown.append(_ShownView(*given, measured, error, labels, psnr_db))

    @property
    def proportions(self) -> Float64[np.ndarray, " K"]:
        """Part of all that is seen that each endmember is, summing to 1."""
        return self._amounts / max(self._amounts.sum(), 1e-12)

    @property
    def confidence(self) -> float | None:
        """Mean estimated probability that the main material of what is seen is right; None where nothing is."""
        return self._sure / self._seen if self._seen > 0 else None

    @property
    def error_of_bands(self) -> Float64[np.ndarray, "2 B"] | None:
        """Root mean squared error of each band over pixels that show matter, and mean of predicted less measured; None
        without measured views."""
        if not self._pixels:
            return None
        return np.stack([np.sqrt(self._squares / self._pixels), self._offsets / self._pixels])

    @property
    def worst_first(self) -> list[_ShownView]:
        """Views with a PSNR, the lowest first."""
        known = [view for view in self.shown if math.isfinite(view.psnr_db)]
        return sorted(known, key=lambda view: view.psnr_db)


class _CaptionedPicture(NamedTuple):
    """A picture, (H, W, 3) sRGB in [0, 1] or 8-bit, with a line below it, and what it shows in words."""

    image: np.ndarray
    caption: str
    alternative: str
    swatch: Colour | None = None


def colour_pictures(views: Sequence[_ShownView]) -> list[_CaptionedPicture]:
    """Each view as measured, as predicted, and their difference; as predicted alone where nothing was measured."""
    pictures: list[_CaptionedPicture] = []
    for view in views:
        if view.measured is None or view.error is None:
            pictures.append(_CaptionedPicture(view.predicted, view.name, f"{view.name}, predicted"))
            continue
        name = f"{view.name}: " if len(view.name) < 40 else ""
        pictures += [
            _CaptionedPicture(view.measured, f"{name}measured", f"{view.name}, measured"),
            _CaptionedPicture(view.predicted, "predicted", f"{view.name}, predicted"),
            _CaptionedPicture(view.error, f"error, PSNR {view.psnr_db:.1f} dB", f"{view.name}, error"),
        ]
    return pictures


def unexplained_pictures(
    scene: TrainedScene, views: Sequence[RunView]
) -> tuple[list[_CaptionedPicture], ColourScale] | None:
    """Where no mixture of the materials gives what was measured, in a few views; None where that is not known."""
    if scene.unexplained is None:
        return None
    output, pictures = scene.output("unexplained"), []
    for view in evenly(views, SHOWN_VIEWS):
        values = picture_values(scene.look(view.camera), output)
        painted = paint(output, values.values, values.opacity, _UNEXPLAINED_RANGE)
        image = as_bytes(painted.over()[:, :, 0])
        pictures.append(_CaptionedPicture(image, view.name, f"{view.name}, {output.title}"))
    return pictures, scale_of(output, _UNEXPLAINED_RANGE)


def share_pictures(views: ReportViews) -> list[tuple[str, list[_CaptionedPicture]]]:
    """Maps of every endmember in the views chosen for it, by view."""
    names, colours = views.materials.names, endmember_colours(views.materials)
    return [
        (
            view.name,
            [
                _CaptionedPicture(image, name, f"{view.name}, abundance of {name}", colour)
                for image, name, colour in zip(view.shares, names, colours, strict=True)
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


def error_chart(views: ReportViews) -> SpectraChart | None:
    """Error against wavelength; None without measured views."""
    if views.error_of_bands is None:
        return None
    nm, (rmse, bias) = views.materials.bands.centers_nm, views.error_of_bands
    lines = [
        ChartLine(nm, rmse, "root mean squared error", "#0b5cad"),
        ChartLine(nm, bias, "mean of predicted less measured", "#c8501e", dash="dashed"),
    ]
    return SpectraChart(lines, f"{views.materials.quantity} (1 = full scale)", (900.0, 300.0))


def segmentation_section(views: ReportViews) -> dict[str, Any]:
    """Materials of some views; against labels where there are some, with a row for each true material: name, colour,
    the endmember that it is matched to, intersection over union."""
    evaluation, chosen = views.evaluation, evenly(views.shown, SHOWN_VIEWS)
    if evaluation is None or not any(view.labels is not None for view in chosen):
        names, colours = views.materials.names, endmember_colours(views.materials)
        pictures = [
            _CaptionedPicture(paint_ids(view.ids, names, colours), view.name, f"{view.name}, materials")
            for view in chosen
        ]
        return {"pictures": pictures, "legend": list(zip(names, colours, strict=True)), "scores": []}
    scores, look = evaluation.segmentation(), material_look(evaluation)
    pictures = []
    for view in chosen:
        labels = view.labels if view.labels is not None else np.full_like(view.ids, NOTHING_ID)
        true, predicted, agreement = look.beside_labels(view.ids, labels, scores.matching)
        pictures += [
            _CaptionedPicture(true, f"{view.name}: labels", f"{view.name}, labels"),
            _CaptionedPicture(predicted, "predicted", f"{view.name}, predicted materials"),
            _CaptionedPicture(agreement, "agreement", f"{view.name}, agreement"),
        ]
    partners = {true: look.pred_names[pred] for pred, true in scores.matching.items()}
    rows = []
    for index, (name, colour) in enumerate(look.true_entries):
        iou = scores.iou.get(index)
        rows.append(
            (name, colour, partners.get(index, "none"), "not in these views" if iou is None else f"{iou:.3f}")
        )
    surplus = [(f"{name} (no match)", colour) for name, colour in look.surplus(scores.matching).values()]
    legend = [*look.true_entries, *surplus, ("right", RIGHT), ("wrong", WRONG)]
    return {"pictures": pictures, "legend": legend, "scores": rows}


class TrueMaterials(NamedTuple):
    """What is known of the scene's materials."""

    names: Sequence[str]
    radiance: Float64[np.ndarray, "M B"]
    """In the light of the model."""


def material_cards(
    materials: Materials,
    proportions: Float64[np.ndarray, " K"],
    light: Float64[np.ndarray, " B"] | None,
    library: MaterialLibrary,
    truth: TrueMaterials | None,
) -> list[dict[str, Any]]:
    """A card for each endmember; its `matches` are what it is like: line, angle in radians, bands compared; where
    nothing known is, `nearest` is what resembles it most: name, angle.

    `proportions` are parts of all that is seen; spectra are seen in `light`, None where it is unknown.
    """
    spectra, nm = materials.endmembers.detach().cpu().double().numpy(), materials.bands.centers_nm
    colours = endmember_colours(materials)
    matches: list[list[tuple[ChartLine, float, int]]] = []
    nearest: list[tuple[str, float] | None] = []
    for found in shown_matches(spectra, materials.bands, light, library):
        matches.append([])
        alike = [shown for shown in found if shown.match.is_alike]
        is_unlike_all = bool(found) and not alike
        nearest.append((found[0].match.name, found[0].match.angle_rad) if is_unlike_all else None)
        for shown, (dash, grey) in zip(alike, _STYLES, strict=False):
            line = ChartLine(nm, shown.spectrum, shown.match.name, grey, 1.5, dash)
            matches[-1].append((line, shown.match.angle_rad, shown.match.num_bands))
    if truth is not None:  # each as bright as the endmember that it is the partner of
        pairs = match_endmembers(torch.from_numpy(spectra), torch.from_numpy(truth.radiance))
        for pred, true, angle in zip(pairs.pred_ids, pairs.true_ids, pairs.angles, strict=True):
            other = truth.radiance[true]
            brightness = float(other @ spectra[pred]) / max(float(other @ other), 1e-30)
            line = ChartLine(nm, brightness * other, f"true: {truth.names[true]}", "#111111", 1.5)
            matches[pred].append((line, angle, len(nm)))
    cards = []
    for index, name in enumerate(materials.names):
        own = ChartLine(nm, spectra[index], name, css_colour(colours[index]), 3.0)
        chart = SpectraChart([*(line for line, *_ in matches[index]), own], materials.quantity)
        seen = {"name": name, "colour": colours[index], "proportion": float(proportions[index])}
        cards.append({**seen, "chart": chart, "matches": matches[index], "nearest": nearest[index]})
    return cards


def region_card(
    name: str, found: MeasuredRegion, materials: Materials, scale: Scale | None
) -> dict[str, Any]:
    """A card for a region: its mean spectrum with one standard deviation to either side, and what it is made of, with
    intervals where they are determined."""
    nm, grey = materials.bands.centers_nm, "#7a838b"
    lines = [
        ChartLine(nm, found.mean - found.spread, "mean less standard deviation", grey, 1.5, "dashed"),
        ChartLine(nm, found.mean + found.spread, "mean and standard deviation", grey, 1.5, "dashed"),
        ChartLine(nm, found.mean, "mean", "#1c2024", 3.0),
    ]
    interval, of_area = found.probe.interval("abundances"), found.area_interval
    reaches = [""] * len(materials.names)
    if interval.is_known:
        reaches = interval.in_words("{:.3f}")
    colours = endmember_colours(materials)
    entries = zip(materials.names, colours, found.abundances.tolist(), reaches, strict=True)
    shares = sorted(entries, key=lambda entry: -entry[2])
    chart, area = SpectraChart(lines, materials.quantity), describe_area(found.area, scale)
    if not of_area.not_determined:
        ends = (describe_area(float(end), scale) for end in (of_area.low, of_area.high))
        area += f" (90 % interval: {' to '.join(ends)})"
    return {
        "name": name,
        "area": area,
        "chart": chart,
        "shares": shares,
        "is_known": interval.is_known,
        "not_determined": interval.not_determined,
    }
