"""What a report shows and counts of views and endmembers, fed view by view; keeps small pictures, never spectra.

Notation: `H x W` pixels, `B` bands, `K` endmembers, `M` true materials.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8

from unmix_plugin.figures.pictures import NEUTRAL, ColourScale, over_neutral, paint
from unmix_plugin.figures.plotting import RIGHT, WRONG, ChartLine, Colour, LineChart, css_colour
from unmix_plugin.formats.files import eight_bits
from unmix_plugin.products.abundances import SHARE_SCALE
from unmix_plugin.products.evaluation import MaterialLook, material_look
from unmix_plugin.products.segmentation import paint_ids
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.evaluation import Evaluation, PredictedView, ViewTruth, as_numpy, picture
from unmix_plugin.trained.measured_surface import MeasuredRegion
from unmix_plugin.trained.measures import Scale, describe_area
from unmix_plugin.trained.run_materials import endmember_colours, shown_matches

SHOWN_VIEWS = 3
_MAP_COLUMNS = (7, 6, 5)


@dataclass(frozen=True)
class _CaptionedPicture:
    """A picture with a line below it."""

    image: np.ndarray
    """(H, W, 3) sRGB, in [0, 1] or 8-bit."""
    caption: str
    alternative: str
    """What it shows, for those who can't see it."""
    swatch: Colour | None = None


@dataclass(frozen=True)
class _ShownSegmentation:
    """Materials of some views; against labels where there are some."""

    pictures: Sequence[_CaptionedPicture]
    legend: Sequence[tuple[str, Colour]]
    scores: Sequence[tuple[str, Colour, str, str]] = ()
    """True material, its colour, the endmember that it is matched to, intersection over union."""


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


def share_pictures(views: ReportViews) -> list[tuple[str, list[_CaptionedPicture]]]:
    """Maps of every endmember in the views chosen for it, by view."""
    colours = endmember_colours(views.materials)
    return [
        (
            view.name,
            [
                _CaptionedPicture(image, name, f"{view.name}, abundance of {name}", colour)
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
        lines,
        "wavelength (nm)",
        f"{views.materials.quantity} (1 = full scale)",
        from_zero=True,
        size=(900.0, 300.0),
    )


def segmentation_pictures(views: ReportViews) -> _ShownSegmentation:
    """Materials of some views; against labels where there are some."""
    evaluation = views.evaluation
    chosen = evenly(views.shown, SHOWN_VIEWS)
    if evaluation is None or not any(view.labels is not None for view in chosen):
        colours = endmember_colours(views.materials)
        pictures = [
            _CaptionedPicture(
                paint_ids(view.ids, dict(enumerate(colours))), view.name, f"{view.name}, materials"
            )
            for view in chosen
        ]
        return _ShownSegmentation(pictures, list(zip(views.materials.names, colours, strict=True)))
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
    return _ShownSegmentation(pictures, legend, rows)


def scale_strip(scale: ColourScale) -> np.ndarray:
    """The colours of a scale from low to high, (12, 220, 3)."""
    return np.repeat(paint(np.linspace(scale.low, scale.high, 220)[None], scale), 12, axis=0)


def _against_labels(
    view: _ShownView, look: MaterialLook, matching: Mapping[int, int]
) -> list[_CaptionedPicture]:
    labels = view.labels if view.labels is not None else np.full_like(view.ids, NOTHING_ID)
    as_true = np.full(256, NOTHING_ID, dtype=np.uint8)
    as_true[list(matching)] = list(matching.values())
    agreement = np.where((as_true[view.ids] != labels)[..., None], WRONG, RIGHT)
    agreement[labels == NOTHING_ID] = NEUTRAL
    predicted = paint_ids(view.ids, look.pred_colours(matching))
    true = paint_ids(labels, dict(enumerate(look.true_colours)))
    return [
        _CaptionedPicture(true, f"{view.name}: labels", f"{view.name}, labels"),
        _CaptionedPicture(predicted, "predicted", f"{view.name}, predicted materials"),
        _CaptionedPicture(agreement, "agreement", f"{view.name}, agreement"),
    ]


NEAR_RAD = 0.1
"""Spectral angle above which the nearest known material is no match."""
_STYLES = (("dashed", "#4b545c"), ("dotted", "#7a838b"), ("solid", "#a2aab1"))


@dataclass(frozen=True)
class TrueMaterials:
    """What is known of the scene's materials."""

    names: Sequence[str]
    radiance: Float64[np.ndarray, "M B"]
    """In the light of the model."""


@dataclass(frozen=True)
class _MaterialCard:
    """What is shown of an endmember."""

    name: str
    colour: Float[np.ndarray, "3"]
    proportion: float
    """Part of all that is seen."""
    chart: LineChart
    matches: Sequence[tuple[ChartLine, float, int]]
    """What it resembles: line, angle in radians, bands compared."""


def material_cards(
    materials: Materials,
    proportions: Float64[np.ndarray, " K"],
    light: Float64[np.ndarray, " B"] | None,
    library: MaterialLibrary,
    truth: TrueMaterials | None,
) -> list[_MaterialCard]:
    """A card for each endmember.

    Args:
        materials: The scene's materials.
        proportions: Part of all that is seen that each is.
        light: In which the spectra are seen; None where it is unknown.
        library: Known materials.
        truth: True materials, where they are known.
    """
    spectra = materials.endmembers.detach().cpu().double().numpy()
    colours = endmember_colours(materials)
    wavelengths = materials.bands.centers_nm
    known = shown_matches(spectra, materials.bands, light, library)
    partners = {} if truth is None else _partners(spectra, truth, wavelengths)
    cards: list[_MaterialCard] = []
    for index, name in enumerate(materials.names):
        matches = [
            (
                ChartLine(wavelengths, shown.spectrum, shown.match.name, grey, 1.5, dash),
                shown.match.angle_rad,
                shown.match.num_bands,
            )
            for shown, (dash, grey) in zip(known[index], _STYLES, strict=False)
        ]
        matches += partners.get(index, ())
        own = ChartLine(wavelengths, spectra[index], name, css_colour(colours[index]), 3.0)
        lines = [*(line for line, *_ in matches), own]
        chart = LineChart(lines, "wavelength (nm)", materials.quantity, from_zero=True, size=(480.0, 240.0))
        cards.append(_MaterialCard(name, colours[index], float(proportions[index]), chart, matches))
    return cards


@dataclass(frozen=True)
class _RegionCard:
    """What is shown of a region that is kept with the run."""

    name: str
    area: str
    chart: LineChart
    shares: Sequence[tuple[str, Float[np.ndarray, "3"], float]]
    """Materials with their colours and abundances, the largest first."""


def region_card(name: str, found: MeasuredRegion, materials: Materials, scale: Scale | None) -> _RegionCard:
    """A card for a region: its mean spectrum with one standard deviation to either side, and what it is made of."""
    nm, ink, grey = materials.bands.centers_nm, "#1c2024", "#7a838b"
    lines = [
        ChartLine(nm, found.mean - found.spread, "mean less standard deviation", grey, 1.5, "dashed"),
        ChartLine(nm, found.mean + found.spread, "mean and standard deviation", grey, 1.5, "dashed"),
        ChartLine(nm, found.mean, "mean", ink, 3.0),
    ]
    chart = LineChart(lines, "wavelength (nm)", materials.quantity, from_zero=True, size=(480.0, 240.0))
    entries = zip(materials.names, endmember_colours(materials), found.abundances.tolist(), strict=True)
    shares = sorted(entries, key=lambda entry: -entry[2])
    return _RegionCard(name, describe_area(found.area, scale), chart, shares)


def _partners(
    spectra: Float64[np.ndarray, "K B"], truth: TrueMaterials, wavelengths: np.ndarray
) -> dict[int, list[tuple[ChartLine, float, int]]]:
    """The true material of each endmember that has one, as bright as the endmember."""
    found = match_endmembers(torch.from_numpy(spectra), torch.from_numpy(truth.radiance))
    partners: dict[int, list[tuple[ChartLine, float, int]]] = {}
    for pred, true, angle in zip(found.pred_ids, found.true_ids, found.angles, strict=True):
        other = truth.radiance[true]
        power = float(other @ other)
        brightness = float(other @ spectra[pred]) / power if power > 0 else 0.0
        line = ChartLine(wavelengths, brightness * other, f"true: {truth.names[true]}", "#111111", 1.5)
        partners[pred] = [(line, angle, len(wavelengths))]
    return partners


ERROR_SCALE = ColourScale("magma", 0.0, 0.1, "root mean squared error over bands")
"""Colours of errors of spectra."""

_ItemT = TypeVar("_ItemT")
_EightBits = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class _ShownView:
    """A view as pictures, 8-bit sRGB, and ids."""

    name: str
    predicted: _EightBits
    ids: UInt8[np.ndarray, "H W"]
    measured: _EightBits | None = None
    error: _EightBits | None = None
    labels: UInt8[np.ndarray, "H W"] | None = None
    psnr_db: float = math.nan
    shares: tuple[_EightBits, ...] = ()
    """One for each endmember, of views chosen for it."""


def evenly(items: Sequence[_ItemT], count: int) -> list[_ItemT]:
    """At most `count` of the items, evenly spread, the first and the last among them.

    >>> evenly("abcdefg", 3)
    ['a', 'd', 'g']
    """
    if len(items) <= count:
        return list(items)
    return [items[index] for index in np.linspace(0, len(items) - 1, count).round().astype(int)]


class ReportViews:
    """Pictures of views, and figures over all of them."""

    def __init__(
        self, materials: Materials, evaluation: Evaluation | None, with_shares: Collection[str]
    ) -> None:
        """
        Args:
            materials: The scene's materials.
            evaluation: Collects the figures of merit; None without measured views.
            with_shares: Names of the views whose abundances are shown.
        """
        num_bands = len(materials.bands)
        self.materials = materials
        self.evaluation = evaluation
        self.shown: list[_ShownView] = []
        self._with_shares = frozenset(with_shares)
        self._squares, self._offsets, self._pixels = np.zeros(num_bands), np.zeros(num_bands), 0
        self._amounts = np.zeros(len(materials.names))
        self._sure, self._seen = 0.0, 0.0

    def add(self, name: str, view: PredictedView, truth: ViewTruth | None) -> None:
        """Count a view, and make its pictures."""
        self._amounts += as_numpy(view.abundances).sum(axis=(0, 1))
        opacity = as_numpy(view.accumulation)
        if view.confidence is not None:
            self._sure += float((as_numpy(view.confidence) * opacity).sum())
            self._seen += float(opacity.sum())
        maps = np.moveaxis(as_numpy(view.shares), -1, 0) if name in self._with_shares else ()
        shares = tuple(eight_bits(over_neutral(paint(one, SHARE_SCALE), opacity)) for one in maps)
        predicted = eight_bits(picture(view.spectra, view.coverage, self.materials.bands))
        ids = view.segmentation.numpy()
        if truth is None or self.evaluation is None:
            self.shown.append(_ShownView(name, predicted, ids, shares=shares))
            return
        figures = self.evaluation.add(truth, view)
        labels = None if truth.counted_labels is None else truth.counted_labels.numpy()
        measured = eight_bits(picture(truth.spectra, truth.opacity, self.materials.bands))
        error = self._count_error(view, truth)
        shown = _ShownView(name, predicted, ids, measured, error, labels, figures["psnr"], shares)
        self.shown.append(shown)

    @property
    def proportions(self) -> Float64[np.ndarray, " K"]:
        """Part of all that is seen that each endmember is, summing to 1."""
        return self._amounts / max(self._amounts.sum(), 1e-12)

    @property
    def confidence(self) -> float | None:
        """Mean estimated probability that the main material of what is seen is right; None where nothing is."""
        return self._sure / self._seen if self._seen > 0 else None

    @property
    def rmse_of_bands(self) -> Float64[np.ndarray, " B"]:
        """Root mean squared error of each band over pixels that show matter; NaN without measured views."""
        return np.sqrt(self._squares / self._pixels) if self._pixels else np.full(len(self._squares), np.nan)

    @property
    def bias_of_bands(self) -> Float64[np.ndarray, " B"]:
        """Mean of predicted less measured over the same pixels."""
        return self._offsets / self._pixels if self._pixels else np.full(len(self._offsets), np.nan)

    @property
    def worst_first(self) -> list[_ShownView]:
        """Views with a PSNR, the lowest first."""
        known = [view for view in self.shown if math.isfinite(view.psnr_db)]
        return sorted(known, key=lambda view: view.psnr_db)

    def _count_error(self, view: PredictedView, truth: ViewTruth) -> _EightBits:
        difference = as_numpy(view.spectra.clamp(0, 1)) - as_numpy(truth.spectra)
        matter = truth.shows_matter.numpy()
        self._squares += (difference[matter] ** 2).sum(axis=0)
        self._offsets += difference[matter].sum(axis=0)
        self._pixels += int(matter.sum())
        painted = paint(np.sqrt((difference**2).mean(axis=-1)), ERROR_SCALE)
        seen = np.maximum(as_numpy(view.coverage), as_numpy(truth.opacity)) > 0.01
        return eight_bits(over_neutral(painted, (seen & truth.valid.numpy()).astype(np.float64)))
