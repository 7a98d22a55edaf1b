"""How cameras see the materials of a run: what a colour asked for in a picture means for a spectrum.

Cameras see an endmember shaded, under highlights and with traces of others, so that pictures of it have another colour
than its spectrum; how much is left to shading, hence how bright an endmember is, training leaves open. What pixels are
made of is linear: each channel of their mean sRGB colour rises with the same channel of the spectrum's linear colour,
and one can be solved for the other.

Notation: `N` pixels, `K` endmembers; a pixel of an endmember is one of which it has the largest share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from unmix_plugin.editing.material_state import MaterialState
from unmix_plugin.editing.operations import Colour
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients
from unmix_plugin.trained.trained_scene import TrainedScene

_NUM_VIEWS = 8
_LONGEST_SIDE_PX = 32
_FEWEST_PIXELS = 16
"""Pixels of an endmember from which its look can be told."""
_LIT_QUANTILE = 0.95
"""Pixels this far up in brightness count as fully lit."""
_PURITY_EXPONENT = 4
"""Of the share, in the weight of a pixel: mixtures must not decide what the material itself looks like."""


def sample_seen(scene: TrainedScene) -> Coefficients:
    """What pixels are made of in coarse pictures of a few training views: rows of pixels (N, ...)."""
    cameras = [view.camera for view in scene.views if view.split == "train"]
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(_NUM_VIEWS, len(cameras))).round().astype(int))
    views = [scene.look(_coarse(cameras[int(i)]), subpixels=1) for i in chosen]
    return Coefficients.concatenate([view.coefficients.flatten() for view in views])


@dataclass(frozen=True)
class Appearance:
    """An endmember as cameras see it."""

    strengths: Float64[np.ndarray, " N"]
    """What its spectrum is multiplied with in each of its pixels: shading times share."""
    behind: Float64[np.ndarray, "N 3"]
    """Linear RGB of what the pixels show besides it."""
    weights: Float64[np.ndarray, " N"]
    """How much each pixel counts: the purer, the more."""

    @property
    def greatest_reflectance(self) -> float:
        """Bound of a reflectance that a fully lit pixel shows as at most 1."""
        return max(1.0, 1.0 / float(np.quantile(self.strengths, _LIT_QUANTILE)))

    def full_colour(self, srgb: Colour) -> Float64[np.ndarray, "3"]:
        """Linear RGB of the spectrum whose pixels have a wanted colour in the mean of sRGB, or come nearest to it where
        what they show besides is brighter."""
        wanted = np.array(srgb)
        low, high = np.zeros(3), np.full(3, 1.0 / self.strengths.min())
        for _ in range(60):
            middle = (low + high) / 2
            is_dark = self.mean_srgb(middle) < wanted
            low, high = np.where(is_dark, middle, low), np.where(is_dark, high, middle)
        return (low + high) / 2

    def mean_srgb(self, linear_rgb: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """What pixels show in the mean if the spectrum has this colour."""
        shown = np.clip(self.behind + self.strengths[:, None] * linear_rgb, 0, 1)
        return np.average(linear_to_srgb(torch.from_numpy(shown)).numpy(), axis=0, weights=self.weights)


def appearance_of(state: MaterialState, index: int) -> Appearance | None:
    """How an endmember looks among the materials as they are now; None where too little of it is seen to tell."""
    seen = state.seen
    if seen is None:
        return None
    is_its = (seen.abundances.argmax(dim=-1) == index) & (seen.accumulation >= OCCUPIED_ACCUMULATION)
    is_its &= seen.scaled_abundances[..., index] > 0
    if int(is_its.sum()) < _FEWEST_PIXELS:
        return None
    scaled, specular = (_rows(values, is_its) for values in (seen.scaled_abundances, seen.specular))
    others = np.where(np.arange(scaled.shape[1]) == index, 0.0, scaled)
    spectra = others @ state.spectra + specular @ state.specular_spectra
    shares = _rows(seen.abundances[..., index] / seen.accumulation, is_its)
    return Appearance(
        scaled[:, index],
        spectra @ rgb_matrix(state.bands, torch.float64).numpy(),
        shares**_PURITY_EXPONENT,
    )


def _rows(values: Tensor, chosen: Tensor) -> np.ndarray:
    return values[chosen].detach().double().cpu().numpy()


def _coarse(camera: Cameras) -> Cameras:
    """The same view in few pixels."""
    shrink = min(1.0, _LONGEST_SIDE_PX / max(camera.width, camera.height))
    return camera.resized(*(max(1, math.floor(side * shrink)) for side in (camera.width, camera.height)))
