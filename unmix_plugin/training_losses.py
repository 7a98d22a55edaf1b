"""What training asks of rendered rays: their spectra first, and what spectra alone leave open.

Notation: `R` pixels, `P` rays through each, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.spectral.losses import forgive_saturation, over_background, solid_evidence, srgb_error
from unmix_plugin.spectral.unmixing.mixture_guide import MixtureGuide

_RGB_WEIGHT_WITH_ALPHA = 0.2


@dataclass(frozen=True)
class LossSettings:
    """Weights of the losses and how they change while training goes on."""

    background: Literal["auto", "random", "black", "white", "last"] = "auto"
    """What lies behind the scene in training: a random grey a ray, black, white, or the colour of the last sample. Auto
    is random where alpha says what is transparent, else black: random greys would reward fog before the cameras."""
    spectral_loss_weight: float = 1.0
    """Weight of the mean squared error of spectra."""
    rgb_loss_weight: float | Literal["auto"] = "auto"
    """Weight of the mean squared error of their sRGB colours, in which dark pixels count more. Auto is 0.2 where alpha
    is known, else 0: where black may be the void, it costs quality."""
    opacity_loss_weight: float = 0.01
    """Weight of the mean squared transparency in scenes without alpha, where pixels aren't dark: light comes from
    something solid, but black may be the void."""
    haze_loss_weight: float = 1e-3
    """Weight at the start of training of matter spread along rays in scenes without alpha, where no hull keeps fog out;
    falls to 0 at `haze_loss_until`."""
    haze_loss_until: float = 0.25
    """Part of the training in which haze is penalised: later it would thin out surfaces."""
    abundance_loss_weight: float = 0.1
    """Weight of the mean squared distance of composited abundances to those of the measured spectra, unmixed one by
    one with the first endmembers; 0 as published."""
    abundance_loss_final_factor: float = 0.1
    """Factor on that weight at the end of training, reached exponentially: once materials are found, what is left of
    their disagreement with single pixels holds spectra back."""
    mixing_penalty: float = 2.0
    """By how much a further material must improve the fit of such a spectrum, in multiples of the mean angle that
    mixtures of two leave unexplained where that is 0.02 rad; less where it is less, more where it is more."""

    def loss_rules(self) -> dict[str, bool]:
        """What the settings must keep to, and whether they do."""
        return {
            "loss weights and the mixing-penalty of at least 0": min(
                self.spectral_loss_weight,
                self.rgb_weight(has_alpha=True),
                self.opacity_loss_weight,
                self.haze_loss_weight,
                self.abundance_loss_weight,
                self.mixing_penalty,
            )
            >= 0,
            "haze-loss-until in (0, 1]": 0 < self.haze_loss_until <= 1,
            "abundance-loss-final-factor in (0, 1]": 0 < self.abundance_loss_final_factor <= 1,
        }

    def rgb_weight(self, has_alpha: bool) -> float:
        """Weight of the error of colours in a scene with or without alpha."""
        if self.rgb_loss_weight == "auto":
            return _RGB_WEIGHT_WITH_ALPHA if has_alpha else 0.0
        return self.rgb_loss_weight

    def haze_weight(self, progress: float) -> float:
        """Weight of the haze when that part of the training is over: falls with the square of the time left."""
        left = max(1 - progress / self.haze_loss_until, 0.0)
        return self.haze_loss_weight * left**2

    def abundance_weight(self, progress: float) -> float:
        """Weight of the guide of abundances when that part of the training is over."""
        return self.abundance_loss_weight * self.abundance_loss_final_factor**progress


def training_losses(
    settings: LossSettings,
    outputs: dict[str, Tensor],
    batch: dict[str, Tensor],
    *,
    has_alpha: bool,
    progress: float,
    rgb_weights: Float[Tensor, "B 3"],
    guide: MixtureGuide,
) -> dict[str, Tensor]:
    """Weighted losses by name; those of no weight are left out.

    Args:
        outputs: Of rays, P for each pixel: `spectral`, `accumulation`, and `abundances` and `haze` if they have weight.
        batch: `spectra` (R, B) and `alpha` (R) of the pixels.
        has_alpha: Whether alpha was measured; else 1 - opacity and haze are penalised.
        progress: Part of the training that is over.
        rgb_weights: From spectra to linear sRGB.
        guide: What the measured spectra say about abundances.
    """
    num_pixels = len(batch["spectra"])
    spectra = pixel_mean(outputs["spectral"], num_pixels)
    opacities = pixel_mean(outputs["accumulation"], num_pixels)
    background = _background(settings, opacities, has_alpha)
    target = over_background(batch["spectra"], batch["alpha"], background)
    predicted = over_background(spectra, opacities, background)
    predicted = forgive_saturation(predicted, target, batch["spectra"])
    losses = {"spectral": settings.spectral_loss_weight * (predicted - target).square().mean()}
    rgb_weight = settings.rgb_weight(has_alpha)
    if rgb_weight > 0:
        losses["rgb"] = rgb_weight * srgb_error(predicted, target, rgb_weights)
    if settings.opacity_loss_weight > 0 and not has_alpha:
        shown = solid_evidence(batch["spectra"])
        losses["opacity"] = settings.opacity_loss_weight * (shown * (1 - opacities).square()).mean()
    haze_weight = 0.0 if has_alpha else settings.haze_weight(progress)
    if haze_weight > 0:
        losses["haze"] = haze_weight * outputs["haze"]
    if settings.abundance_loss_weight > 0:
        abundances = pixel_mean(outputs["abundances"], num_pixels)
        error = guide.error(abundances, batch["spectra"], batch["alpha"])
        losses["abundances"] = settings.abundance_weight(progress) * error
    return losses


def pixel_mean(values: Float[Tensor, "S *channels"], num_pixels: int) -> Float[Tensor, "R *channels"]:
    """Means over the rays cast through each pixel, which follow each other."""
    return values.unflatten(0, (num_pixels, -1)).mean(dim=1)


def _background(
    settings: LossSettings, opacities: Float[Tensor, "R"], has_alpha: bool
) -> Float[Tensor, "R 1"]:
    """The grey that both sides of the comparison are laid over."""
    shade = torch.zeros_like(opacities)[:, None]
    if settings.background == "random" or (settings.background == "auto" and has_alpha):
        return torch.rand_like(shade)
    return shade + 1 if settings.background == "white" else shade
