"""How noisy each band is, and how much its errors should count.

Least squares is right where noise is alike in all bands. Where it isn't, a noisy band pulls spectra and materials at
random: its squared errors count less then, in proportion to the reciprocal of its variance. Noise that is small against
what any model misses does not matter, so bands are only told apart where it exceeds that.

Notation: `N` pixels, `B` bands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.spectral.evidence import brightness
from unmix_plugin.spectral.unmixing.num_materials import estimate_noise

FEWEST_BANDS, PIXELS_PER_BAND = 8, 10
"""Least number of bands, and of pixels for each, from which noise can be estimated."""
PLAIN_FACTOR = 3.0
"""Noise up to this multiple of the usual band's weighs nothing down."""
PLAIN_NOISE = 0.02
"""Share of the median brightness up to which a band counts as clean, whatever the others are."""
NOISE_SHARE = 0.7
"""Standard deviation of noise, as a share of the band's own, above which a band is mostly noise."""
DEAD_SPREAD, LEAST_WEIGHT = 1e-5, 1e-4
"""Standard deviation up to which a band shows one value everywhere; and its weight, before weights are scaled."""
_SIGMA_OF_MAD = 1.4826


@dataclass(frozen=True)
class BandNoise:
    """What a sensor's bands are worth."""

    sigmas: Float[Tensor, "B"]
    """Standard deviation of the noise of each, outliers left out."""
    weights: Float[Tensor, "B"]
    """Of squared errors, mean 1; exactly 1 where no band is much noisier than the others."""
    mostly_noise: Bool[Tensor, "B"]
    """Bands that show more noise than spectra."""
    dead: Bool[Tensor, "B"]
    """Bands that show one value everywhere."""

    @staticmethod
    def unknown(num_bands: int) -> BandNoise:
        """Where nothing tells bands apart."""
        none = torch.zeros(num_bands, dtype=torch.bool)
        return BandNoise(torch.zeros(num_bands), torch.ones(num_bands), none, none)


def judge_bands(pixels: Float[Tensor, "N B"]) -> BandNoise:
    """Noise from what the other bands can't predict of a band, as HySime has it, but by median absolute deviations.

    Args:
        pixels: Spectra of a scene, background left out.
    """
    num_bands = pixels.shape[1]
    if num_bands < FEWEST_BANDS or len(pixels) < PIXELS_PER_BAND * num_bands:
        return BandNoise.unknown(num_bands)
    dead = pixels.double().std(dim=0) <= DEAD_SPREAD
    if int((~dead).sum()) < FEWEST_BANDS:
        return replace(BandNoise.unknown(num_bands), dead=dead)
    sigmas = pixels.new_zeros(num_bands)
    sigmas[~dead] = _robust_spread(estimate_noise(pixels[:, ~dead]))
    usual = torch.maximum(sigmas[~dead].median(), PLAIN_NOISE * brightness(pixels[:, ~dead]).median())
    weights = (PLAIN_FACTOR * usual / sigmas.clamp(min=1e-12)).square().clamp(LEAST_WEIGHT, 1.0)
    weights = torch.where(dead, LEAST_WEIGHT, weights)
    if bool((weights < 1).any()):
        weights = weights / weights.mean()
    is_noise = (sigmas > NOISE_SHARE * pixels.std(dim=0)) & (weights < 1) & ~dead
    return BandNoise(sigmas, weights, is_noise, dead)


def _robust_spread(values: Float[Tensor, "N B"]) -> Float[Tensor, "B"]:
    return _SIGMA_OF_MAD * (values - values.median(dim=0).values).abs().median(dim=0).values
