"""What rendered rays are compared with in training: their spectra first, and what spectra alone leave open.

Notation: `R` pixels, `P` rays through each, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import require
from unmix_plugin.presets import AlphaPreset, Auto, choose
from unmix_plugin.spectral.evidence import (
    bounded_square,
    forgive_saturation,
    is_blown_out,
    over_background,
    relative_weights,
    solid_evidence,
    srgb_error,
)

Background = Literal["random", "black", "white", "last"]

_WEIGHTS = ("spectral", "rgb", "opacity", "spread", "surface", "normals", "abundances", "mixing_penalty")


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses and how they change during training."""

    background: Background | Auto = "auto"
    """What lies behind the scene in training: a random grey a ray, black, white, or the colour of the last sample. Auto
    is random where alpha is known, otherwise black."""
    spectral: float = 1.0
    """Weight of the mean squared error of spectra."""
    band_weights: tuple[float, ...] | Auto = "auto"
    """Weight of the squared error in each band of the scene; none are equal weights. Auto gives less to bands that are
    much noisier than the others, or dead: the reciprocal of their noise's variance. The mean is 1."""
    rgb: float | Auto = "auto"
    """Weight of the mean squared error of their sRGB colours, in which dark pixels count more. Auto is 0.2 where alpha
    is known, otherwise 0: where black may be the void, it costs quality."""
    opacity: float | Auto = "auto"
    """Weight of the mean squared transparency of pixels that are not dark: light comes from something solid. Auto is
    0.01 where alpha is unknown, otherwise 0."""
    spread: float | Auto = "auto"
    """Weight, at the start of training, of density spread along rays, which removes floaters; falls to 0 at
    `spread_until`. Auto is 0.001 where alpha is unknown, otherwise 0."""
    spread_until: float = 0.25
    """Part of the training in which spread density is penalised: later it would thin out surfaces."""
    surface: float | Auto = "auto"
    """Weight, at the start of training, of light from elsewhere than the surface that the views agree on, where they do
    clearly; falls to 0 at `surface_until`. Auto is 0.3 in an unbounded world, otherwise 0."""
    surface_until: float = 0.5
    """Part of the training in which known surfaces guide it: later they would hold back what is finer."""
    normals: float = 0.01
    """Weight, at the start of training, of the disagreement of normals that shading by a moving lamp learns with those
    of the densities; falls to 0 at `normals_until`. Without such a lamp there is none."""
    normals_until: float = 1.0
    """Part of the training in which densities guide normals."""
    abundances: float = 0.1
    """Weight of the mean squared distance of composited abundances to those of the measured spectra, unmixed one by
    one with the first endmembers; 0 as published."""
    abundances_final_factor: float = 0.1
    """Factor on that weight at the end of training, reached exponentially: once materials are found, what is left of
    their disagreement with single pixels holds spectra back."""
    exposure: float | Auto = "auto"
    """Factor on spectra, rendered and measured, before they are compared: errors of dark scenes count as much as those
    of bright ones. Auto makes the median opaque pixel as bright as 0.2, but darkens nothing."""
    outlier: float = 1.0
    """Error of an exposed value above which it counts in proportion instead of squared. It matters in dark scenes
    only: a blown-out pixel would otherwise outweigh all others. What a saturated value misses is unknown anyway, so for
    such pixels the bound is divided by the exposure."""
    relative: float | Auto = "auto"
    """Power of a pixel's brightness by which squared errors of its spectrum are divided: 0 for absolute errors, 2 for
    relative ones. Auto is 0 unless alpha is known and the brighter pixels are much brighter than the others."""
    mixing_penalty: float = 2.0
    """By how much a further material must improve the fit of such a spectrum, in multiples of the mean angle that
    mixtures of two leave unexplained where that is 0.02 rad; less where it is less, more where it is more."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range.
        """
        weights = {name: getattr(self, name) for name in _WEIGHTS}
        rules = {
            **{
                f"{name.replace('_', '-')} of at least 0": weight == "auto" or weight >= 0
                for name, weight in weights.items()
            },
            "band-weights above 0, auto or none": self.band_weights == "auto"
            or all(weight > 0 for weight in self.band_weights),
            "an exposure above 0 or auto": self.exposure == "auto" or self.exposure > 0,
            "outlier above 0": self.outlier > 0,
            "relative in [0, 2] or auto": self.relative == "auto" or 0 <= self.relative <= 2,
            "spread-until in (0, 1]": 0 < self.spread_until <= 1,
            "surface-until in (0, 1]": 0 < self.surface_until <= 1,
            "normals-until in (0, 1]": 0 < self.normals_until <= 1,
            "abundances-final-factor in (0, 1]": 0 < self.abundances_final_factor <= 1,
        }
        require("the losses", self, rules)

    def weights(self, preset: AlphaPreset, progress: float) -> dict[str, float]:
        """Weight of each loss when that part of the training is over, by name."""
        return {
            "spectral": self.spectral,
            "rgb": choose(self.rgb, preset.rgb_loss_weight),
            "opacity": choose(self.opacity, preset.opacity_loss_weight),
            "spread": choose(self.spread, preset.spread_loss_weight) * fading(progress, self.spread_until),
            "surface": choose(self.surface, preset.surface_loss_weight)
            * fading(progress, self.surface_until),
            "normals": self.normals * fading(progress, self.normals_until),
            "abundances": self.abundances * self.abundances_final_factor**progress,
        }


def fading(progress: float, until: float) -> float:
    """From 1 at the start of training to 0 at `until`, slower and slower."""
    return max(1 - progress / until, 0.0) ** 2


@dataclass(frozen=True)
class PixelComparison:
    """Rendered and measured pixels of a batch over one background."""

    predicted: Float[Tensor, "R B"]
    target: Float[Tensor, "R B"]
    opacities: Float[Tensor, "R"]
    """Rendered."""
    outliers: Float[Tensor, "R 1"]
    """Error of a pixel's values above which it is not squared."""


def compare_pixels(
    spectra: Float[Tensor, "S B"],
    accumulation: Float[Tensor, "S"],
    batch: dict[str, Tensor],
    background: Background,
    generator: torch.Generator | None,
    exposure: float = 1.0,
    outlier: float = math.inf,
) -> PixelComparison:
    """Lay rendered and measured pixels over one background; saturated pixels can't be exceeded.

    Args:
        spectra, accumulation: Of rays, P for each pixel.
        batch: `spectra` (R, B), `alpha` (R) and, unless all is to be trusted, `alpha_trust` (R) of the pixels.
        background, generator: What lies behind both, and the source of random greys. It is black where alpha is not
            to be trusted: then only light counts.
        exposure, outlier: As `LossConfig` has them.
    """
    measured = batch["spectra"]
    opacities = pixel_mean(accumulation, len(measured))
    grey = torch.zeros_like(opacities)[:, None]
    if background == "random":
        device = grey.device if generator is None else generator.device
        grey = torch.rand(grey.shape, generator=generator, device=device).to(grey)
    elif background == "white":
        grey = grey + 1
    if "alpha_trust" in batch:
        grey = grey * batch["alpha_trust"][:, None]
    target = over_background(exposure * measured, batch["alpha"], grey)
    predicted = over_background(exposure * pixel_mean(spectra, len(measured)), opacities, grey)
    outliers = torch.where(is_blown_out(measured), outlier / exposure, outlier)[:, None]
    return PixelComparison(forgive_saturation(predicted, target, measured), target, opacities, outliers)


def spectral_losses(
    pixels: PixelComparison,
    measured: Float[Tensor, "R B"],
    rgb_weights: Float[Tensor, "B 3"],
    wanted: set[str],
    band_weights: Float[Tensor, "B"] | None = None,
    relative: float = 0.0,
) -> dict[str, Tensor]:
    """Those of `spectral`, `rgb` and `opacity` that are wanted, not yet weighted; bands count alike without weights.

    Args:
        relative: As `LossConfig` has it.
    """
    squares = bounded_square(pixels.predicted - pixels.target, pixels.outliers)
    if band_weights is not None:
        squares = band_weights * squares
    if relative > 0:
        squares = relative_weights(pixels.predicted, relative)[:, None] * squares
    losses = {"spectral": squares.mean()}
    if "rgb" in wanted:
        losses["rgb"] = srgb_error(pixels.predicted, pixels.target, rgb_weights, pixels.outliers)
    if "opacity" in wanted:
        losses["opacity"] = (solid_evidence(measured) * (1 - pixels.opacities).square()).mean()
    return losses


def pixel_mean(values: Float[Tensor, "S *channels"], num_pixels: int) -> Float[Tensor, "R *channels"]:
    """Means over the rays cast through each pixel, which follow each other."""
    return values.unflatten(0, (num_pixels, -1)).mean(dim=1)
