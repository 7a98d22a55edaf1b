"""What a report shows and counts of views, fed view by view; keeps small pictures, never spectra.

Notation: `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, UInt8

from unmix_plugin.figures.pictures import ColourScale, over_neutral, paint
from unmix_plugin.products.abundances import SHARE_SCALE
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import Evaluation, ViewTruth
from unmix_plugin.trained.view_rendering import RenderedView, as_numpy, picture

ERROR_SCALE = ColourScale("magma", 0.0, 0.1, "root mean squared error over bands")
"""Colours of errors of spectra."""

ItemT = TypeVar("ItemT")
EightBits = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class ShownView:
    """A view as pictures, 8-bit sRGB, and ids."""

    name: str
    predicted: EightBits
    ids: UInt8[np.ndarray, "H W"]
    measured: EightBits | None = None
    error: EightBits | None = None
    labels: UInt8[np.ndarray, "H W"] | None = None
    psnr_db: float = math.nan
    shares: tuple[EightBits, ...] = ()
    """One for each endmember, of views chosen for it."""


def evenly(items: Sequence[ItemT], count: int) -> list[ItemT]:
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
        self.shown: list[ShownView] = []
        self._with_shares = frozenset(with_shares)
        self._squares, self._offsets, self._pixels = np.zeros(num_bands), np.zeros(num_bands), 0
        self._amounts = np.zeros(len(materials.names))

    def add(self, name: str, view: RenderedView, truth: ViewTruth | None) -> None:
        """Count a view, and make its pictures."""
        self._amounts += as_numpy(view.abundances).sum(axis=(0, 1))
        shares = self._share_pictures(view) if name in self._with_shares else ()
        predicted = _eight_bits(picture(view.spectra, view.coverage, self.materials.bands))
        ids = view.segmentation.numpy()
        if truth is None or self.evaluation is None:
            self.shown.append(ShownView(name, predicted, ids, shares=shares))
            return
        figures = self.evaluation.add(truth, view)
        labels = None if truth.labels is None else truth.labels.numpy()
        measured = _eight_bits(picture(truth.spectra, truth.opacity, self.materials.bands))
        error = self._count_error(view, truth)
        shown = ShownView(name, predicted, ids, measured, error, labels, figures["psnr"], shares)
        self.shown.append(shown)

    @property
    def proportions(self) -> Float64[np.ndarray, " K"]:
        """Part of all that is seen that each endmember is, summing to 1."""
        return self._amounts / max(self._amounts.sum(), 1e-12)

    @property
    def rmse_of_bands(self) -> Float64[np.ndarray, " B"]:
        """Root mean squared error of each band over pixels that show matter; NaN without measured views."""
        return np.sqrt(self._squares / self._pixels) if self._pixels else np.full(len(self._squares), np.nan)

    @property
    def bias_of_bands(self) -> Float64[np.ndarray, " B"]:
        """Mean of predicted less measured over the same pixels."""
        return self._offsets / self._pixels if self._pixels else np.full(len(self._offsets), np.nan)

    @property
    def worst_first(self) -> list[ShownView]:
        """Views with a PSNR, the lowest first."""
        known = [view for view in self.shown if math.isfinite(view.psnr_db)]
        return sorted(known, key=lambda view: view.psnr_db)

    def _count_error(self, view: RenderedView, truth: ViewTruth) -> EightBits:
        difference = as_numpy(view.spectra.clamp(0, 1)) - as_numpy(truth.spectra)
        matter = truth.shows_matter.numpy()
        self._squares += (difference[matter] ** 2).sum(axis=0)
        self._offsets += difference[matter].sum(axis=0)
        self._pixels += int(matter.sum())
        painted = paint(np.sqrt((difference**2).mean(axis=-1)), ERROR_SCALE)
        seen = np.maximum(as_numpy(view.coverage), as_numpy(truth.opacity)) > 0.01
        return _eight_bits(over_neutral(painted, seen.astype(np.float64)))

    def _share_pictures(self, view: RenderedView) -> tuple[EightBits, ...]:
        opacity = as_numpy(view.accumulation)
        maps = np.moveaxis(as_numpy(view.shares), -1, 0)
        return tuple(_eight_bits(over_neutral(paint(one, SHARE_SCALE), opacity)) for one in maps)


def _eight_bits(colours: np.ndarray) -> EightBits:
    return np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)
