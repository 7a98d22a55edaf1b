"""The material of each pixel, and agreement with true labels.

Notation: `K` endmembers, predicted material ids 0..K-1; `M` true materials, labels 0..M-1; 255 says "nothing here" in a
prediction and "unlabelled" in the truth.

The protocol (docs/reference/figures.md): pixels with the true label 255 are ignored. Predicted ids are matched to true
materials one to one, once per scene, on intersection over union over all views. On a labelled pixel, a predicted 255
and an id without a partner are misses of the true material. A true material without a partner has IoU and F1 of 0.
One that occurs in no view is left out of the matching and of the means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from unmix_plugin.errors import SpectrumError, counted

NOTHING_ID = 255
"""Predicted id of a pixel with nothing in it; true label of an unlabelled pixel."""


def material_scores(
    spectra: Float[Tensor, "*rays B"], endmembers: Float[Tensor, "K B"]
) -> Float[Tensor, "*rays K"]:
    """Cosine of the spectrum to each endmember, in [-1, 1]; 0 for spectra of zero length.

    >>> material_scores(torch.tensor([0.0, 2.0]), torch.tensor([[1.0, 0.0], [0.0, 1.0]]))
    tensor([0., 1.])
    """
    normalize = torch.nn.functional.normalize
    return normalize(spectra, dim=-1) @ normalize(endmembers, dim=-1).T


def material_ids(
    scores: Float[Tensor, "*rays K"], accumulations: Float[Tensor, "*rays"], threshold: float = 0.5
) -> UInt8[Tensor, "*rays"]:
    """The best-scoring material of each ray, 255 where accumulation is below the threshold; of at most 255 materials.

    >>> material_ids(torch.tensor([[0.1, 0.9], [0.9, 0.1]]), torch.tensor([1.0, 0.2]))
    tensor([  1, 255], dtype=torch.uint8)
    """
    _require_countable(scores.shape[-1])
    ids = scores.argmax(dim=-1).to(torch.uint8)
    return torch.where(accumulations < threshold, torch.full_like(ids, NOTHING_ID), ids)


@dataclass(frozen=True)
class SegmentationScores:
    """Agreement with the truth over a scene; NaN without labelled pixels."""

    miou: float
    """Mean intersection over union of the true materials that occur."""
    macro_f1: float
    """Mean F1 of the true materials that occur."""
    accuracy: float
    """Share of labelled pixels whose matched id is right."""
    matching: dict[int, int]
    """Predicted id -> true material; without pairs that have no pixel in common, which stand for nothing."""
    iou: dict[int, float]
    """Intersection over union of each true material that occurs."""


class SegmentationTally:
    """Confusion counts of a scene, fed view by view; memory does not grow with views."""

    def __init__(self, num_pred: int, num_true: int) -> None:
        """Start with nothing counted, for 1 to 255 predicted and true materials."""
        _require_countable(num_pred)
        _require_countable(num_true)
        self.confusion: Int64[np.ndarray, "rows M"] = np.zeros((num_pred + 1, num_true), dtype=np.int64)
        """Pixels by predicted id and true label; the last row counts predictions of 255."""

    def add(self, pred_ids: UInt8[Tensor, "*pixels"], true_labels: UInt8[Tensor, "*pixels"]) -> None:
        """Count one view; an id or label that is neither below the declared number nor 255 is refused."""
        num_pred, num_true = self.confusion.shape[0] - 1, self.confusion.shape[1]
        pred, true = (ids.detach().cpu().long().numpy().ravel() for ids in (pred_ids, true_labels))
        _require_known(pred, num_pred, "predicted ids")
        _require_known(true, num_true, "true labels")
        labelled = true != NOTHING_ID
        rows = np.where(pred == NOTHING_ID, num_pred, pred)[labelled]
        cells = np.bincount(rows * num_true + true[labelled], minlength=self.confusion.size)
        self.confusion += cells.reshape(self.confusion.shape)

    def scores(self) -> SegmentationScores:
        """Match once over everything counted so far, then score."""
        from scipy.optimize import linear_sum_assignment

        present = np.flatnonzero(self.confusion.sum(axis=0))
        if len(present) == 0:
            return SegmentationScores(math.nan, math.nan, math.nan, {}, {})
        hits = self.confusion[:-1, present].astype(np.float64)
        num_true = self.confusion[:, present].sum(axis=0)
        num_either = hits.sum(axis=1)[:, None] + num_true
        iou = hits / (num_either - hits)
        pred, column = linear_sum_assignment(iou, maximize=True)
        matched_hits, matched_either = np.zeros(len(present)), np.ones(len(present))
        matched_hits[column], matched_either[column] = hits[pred, column], num_either[pred, column]
        matched_iou = matched_hits / (matched_either - matched_hits)
        return SegmentationScores(
            miou=float(matched_iou.mean()),
            macro_f1=float((2 * matched_hits / matched_either).mean()),
            accuracy=float(matched_hits.sum() / num_true.sum()),
            matching={int(p): int(present[c]) for p, c in zip(pred, column, strict=True) if hits[p, c] > 0},
            iou={int(m): float(value) for m, value in zip(present, matched_iou, strict=True)},
        )


def _require_countable(num_materials: int) -> None:
    if not 1 <= num_materials <= NOTHING_ID:
        raise SpectrumError(
            f"the number of materials must lie between 1 and {NOTHING_ID}; found {num_materials}"
        )


def _require_known(ids: np.ndarray, num_known: int, what: str) -> None:
    unknown = ids[(ids >= num_known) & (ids != NOTHING_ID)]
    if unknown.size:
        raise SpectrumError(
            f"{what} must be below {num_known} or {NOTHING_ID}; found {unknown.max()} in "
            f"{counted(unknown.size, 'pixel')}"
        )
