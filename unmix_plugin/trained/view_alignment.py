"""The gain of an evaluation view, fitted to what was measured of it, where each training view had a gain of its own.

A trained gain says nothing of views that were not trained on, so each is aligned first, with the same few numbers as in
training: exposure and a smooth white balance. Figures after it say how well a view is predicted but for these.

Notation: `B` bands, `T` terms.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.light.view_gains import smooth_terms
from unmix_plugin.spectral.evidence import is_blown_out
from unmix_plugin.trained.evaluation import ViewTruth
from unmix_plugin.trained.view_rendering import RenderedView

_NUM_STEPS = 20


def align_gain(predicted: RenderedView, truth: ViewTruth, wavelengths_nm: Float[Tensor, "B"]) -> RenderedView:
    """The prediction times the smooth gain with which it comes nearest to the measured view."""
    counts = truth.shows_matter & ~is_blown_out(truth.spectra)
    if not bool(counts.any()):
        return predicted
    shown, measured = predicted.spectra[counts].double(), truth.spectra[counts].double()
    gain = fitted_gain((shown * shown).sum(dim=0), (shown * measured).sum(dim=0), wavelengths_nm.double())
    return replace(predicted, spectra=predicted.spectra * gain.to(predicted.spectra))


def fitted_gain(
    power: Float[Tensor, "B"], agreement: Float[Tensor, "B"], wavelengths_nm: Float[Tensor, "B"]
) -> Float[Tensor, "B"]:
    """Smooth gain g of least squared error, by Gauss-Newton steps.

    Args:
        power, agreement: Sums over pixels of p p and p m, where p is predicted and m measured.
    """
    terms = smooth_terms(wavelengths_nm)
    logs = torch.zeros(len(terms), dtype=terms.dtype)
    ridge = 1e-9 * power.sum() * torch.eye(len(terms), dtype=terms.dtype)
    for _ in range(_NUM_STEPS):
        gain = (logs @ terms).exp()
        slopes = (terms * (power * gain * gain)) @ terms.T + ridge
        step = torch.linalg.solve(slopes, terms @ (agreement * gain - power * gain * gain))
        logs = logs + step.clamp(-0.5, 0.5)
    return (logs @ terms).exp()
