"""Prediction beside truth, a figure a view: colour and its error, segmentation, abundances.

True materials keep their colours in all figures; a predicted endmember has the colour of the material that it is
matched to, and one of its own where it is matched to none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.figures.pictures import (
    NEUTRAL,
    ColourScale,
    TitledPicture,
    draw_panels,
    in_rows,
    over_neutral,
    paint,
)
from unmix_plugin.figures.plotting import RIGHT, WRONG, Colour, distinct_colours, own_colours
from unmix_plugin.products.abundances import SHARE_SCALE, share_panels
from unmix_plugin.products.segmentation import paint_ids
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import describe_colour, linear_to_srgb
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.evaluation import Evaluation, ViewTruth
from unmix_plugin.trained.view_rendering import RenderedView, as_numpy, coloured_picture

_ERROR_SCALE = ColourScale("magma", 0.0, 0.2, "error of sRGB")
_COLUMNS = 7


@dataclass(frozen=True)
class MaterialLook:
    """Names and colours of true materials and predicted endmembers in one evaluation."""

    true_names: tuple[str, ...]
    true_colours: Float[np.ndarray, "K 3"]
    pred_names: tuple[str, ...]
    surplus_colours: Float[np.ndarray, "P 3"]
    """Colours of predicted endmembers that stand for no true material."""

    @property
    def true_entries(self) -> list[tuple[str, Colour]]:
        """Name and colour of each true material."""
        return list(zip(self.true_names, self.true_colours, strict=True))

    def pred_colours(self, matching: Mapping[int, int]) -> dict[int, np.ndarray]:
        """Colour of each predicted endmember.

        Args:
            matching: Predicted -> true.
        """
        return {
            index: self.true_colours[matching[index]] if index in matching else self.surplus_colours[index]
            for index in range(len(self.pred_names))
        }


def material_look(evaluation: Evaluation) -> MaterialLook:
    """Names and colours for all figures of an evaluation."""
    truth, endmembers = evaluation.truth, evaluation.endmembers
    grey = torch.full((truth.num_materials, len(truth.bands)), 0.2, dtype=torch.float64)
    spectra = grey if truth.endmembers is None else truth.endmembers.double()
    colours = distinct_colours(own_colours(torch.cat([spectra, endmembers]), truth.bands))
    return MaterialLook(
        truth.names or tuple(f"material {index}" for index in range(len(spectra))),
        colours[: len(spectra)],
        evaluation.names,
        colours[len(spectra) :],
    )


def draw_colour(view: ViewTruth, predicted: RenderedView, bands: Bands, psnr_db: float) -> bytes:
    """True colour, predicted colour, and their difference; in false colours for sensors without all bands."""
    weights, spectra = view.colour_weights(bands), view.seen(predicted.spectra)
    error = np.abs(_srgb_on_black(spectra, weights) - _srgb_on_black(view.spectra, weights)).mean(axis=-1)
    seen = np.maximum(as_numpy(view.opacity), as_numpy(predicted.coverage))
    panels = [
        TitledPicture(coloured_picture(view.spectra, view.opacity, weights), "true"),
        TitledPicture(coloured_picture(spectra, predicted.coverage, weights), "predicted"),
        TitledPicture(over_neutral(paint(error, _ERROR_SCALE), (seen > 0.01).astype(np.float64)), "error"),
    ]
    colours = describe_colour(bands).split(":")[0] if view.sensor is None else f"seen by {view.sensor.name}"
    heading = f"{view.name}: {colours}, spectral PSNR {psnr_db:.1f} dB"
    return draw_panels([panels], heading, _ERROR_SCALE)


def draw_matched_segmentation(
    name: str,
    labels: UInt8[np.ndarray, "H W"] | None,
    ids: UInt8[np.ndarray, "H W"],
    look: MaterialLook,
    matching: Mapping[int, int],
) -> bytes:
    """True labels, predicted materials in the colours of those they are matched to, and where they differ."""
    colours = look.pred_colours(matching)
    as_true = np.full(256, NOTHING_ID, dtype=np.uint8)
    as_true[list(matching)] = list(matching.values())
    panels = [TitledPicture(paint_ids(ids, colours), "predicted")]
    seen = set(np.unique(as_true[ids]).tolist())
    extra: list[tuple[str, Colour]] = []
    if labels is not None:
        agreement = np.where((as_true[ids] != labels)[..., None], WRONG, RIGHT)
        agreement[labels == NOTHING_ID] = NEUTRAL
        true = TitledPicture(paint_ids(labels, dict(enumerate(look.true_colours))), "true")
        panels = [true, *panels, TitledPicture(agreement, "disagreement")]
        seen |= set(np.unique(labels).tolist())
        extra = [("right", RIGHT), ("wrong", WRONG), ("unlabelled", (NEUTRAL,) * 3)]
    true_entries = [entry for index, entry in enumerate(look.true_entries) if index in seen]
    surplus = [
        (name, colours[index])
        for index, name in enumerate(look.pred_names)
        if index not in matching and (ids == index).any()
    ]
    return draw_panels([panels], f"{name}: segmentation", legend=true_entries + surplus + extra)


def draw_matched_abundances(
    view: ViewTruth, predicted: RenderedView, evaluation: Evaluation, look: MaterialLook
) -> bytes:
    """Each true material's abundance above that of the endmember matched to it; surplus endmembers at the end."""
    swatches = own_colours(evaluation.endmembers, evaluation.truth.bands)
    pred_panels = share_panels(predicted.shares, predicted.accumulation, look.pred_names, swatches)
    heading, matching = f"{view.name}: abundances", evaluation.matching
    if view.abundances is None or matching is None:
        return draw_panels(in_rows(pred_panels), heading, SHARE_SCALE)
    has_truth = view.abundances.sum(dim=-1) > 0
    true_panels = share_panels(view.abundances, view.opacity * has_truth, look.true_names, look.true_colours)
    blank = TitledPicture(np.full_like(true_panels[0].image, NEUTRAL), "none matched")
    partners = dict(zip(matching.true_ids, matching.pred_ids, strict=True))
    partner_panels = [
        pred_panels[partners[index]] if index in partners else blank for index in range(len(true_panels))
    ]
    columns = min(len(true_panels), _COLUMNS)
    pairs = zip(in_rows(true_panels, columns), in_rows(partner_panels, columns), strict=True)
    surplus = [panel for index, panel in enumerate(pred_panels) if index not in matching.pred_ids]
    rows = [row for pair in pairs for row in pair] + in_rows(surplus, columns)
    return draw_panels(rows, f"{heading}, true above predicted (matched by spectral angle)", SHARE_SCALE)


def _srgb_on_black(spectra: Float[Tensor, "H W b"], weights: Float[Tensor, "b 3"]) -> np.ndarray:
    linear = spectra.double().clamp(0, 1) @ weights
    return linear_to_srgb(linear.clamp(0, 1)).numpy()
