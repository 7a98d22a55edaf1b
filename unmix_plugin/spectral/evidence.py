"""What a measured pixel tells, and how far a rendered one is from it.

Alpha is an observation like light, and masks err: by a pixel along edges, with holes and specks. Where the two
contradict each other, alpha has no confidence, and only light counts.

Notation: `R` pixels, `B` bands; spectra are on black, premultiplied by alpha. The brightness of a pixel is the root
mean square of its spectrum.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.sampling import SIGMA_OF_MEDIAN_DEVIATION

OPAQUE_ALPHA = 0.99
"""From which on a pixel shows nothing of what is behind it."""
DARK_RMS = 0.005
"""Brightness up to which a pixel counts as black: the direction of its spectrum is noise."""
_TRANSPARENT = 0.5 / 255
"""Largest alpha of a pixel that shows nothing."""
_BLOWN_OUT = 0.9
_SIGMAS = 6.0
"""Standard deviations of the background's noise above its median that still count as background."""
_DARK_SHARE = 0.5
"""The background must be darker than this share of the median brightness of what is not background."""
_FAINTEST_SURPLUS = 0.02
"""Brightness beyond what alpha allows that contradicts it: alpha is rounded, and edges are filtered."""
_PLAIN_BRIGHTNESS = 0.2
"""Median brightness of opaque pixels from which a scene counts as well exposed; of a pixel that keeps its weight."""
_LARGEST_EXPOSURE = 100.0
_BRIGHTER_PART = 0.9
"""Quantile of brightness that is compared with the median."""
_PLAIN_CONTRAST = 2.75
"""Brightness of that quantile, in medians, up to which absolute errors are right."""
_LARGEST_POWER = 1.5
"""Of brightness by which squared errors are divided, where that quantile is at least twice as bright as that."""
_FAINT = 0.02
"""Brightness below which weights hardly grow: there is noise."""
_SURELY_LIT = 0.05
"""Root mean square over bands from which a pixel surely shows something."""


def brightness(spectra: Float[Tensor, "R B"]) -> Float[Tensor, "R"]:
    """Root mean square over bands."""
    return spectra.square().mean(dim=-1).sqrt()


def has_spectral_shape(spectra: Float[Tensor, "R B"]) -> Bool[Tensor, "R"]:
    """Where a pixel is neither black (brightness at most 0.005) nor saturated (1 or above)."""
    return (spectra.amax(dim=-1) < 1) & (brightness(spectra) > DARK_RMS)


def is_blown_out(spectra: Float[Tensor, "*pixels B"]) -> Bool[Tensor, "*pixels"]:
    """Pixels with a band above 0.9: cameras, filters and codecs end a little below full scale. The light was at least
    so strong."""
    return (spectra > _BLOWN_OUT).any(dim=-1)


def background_level(spectra: Float[Tensor, "R B"], alpha: Float[Tensor, "R"]) -> float | None:
    """Brightness up to which a pixel can't be distinguished from the background.

    0 where the background is black; None where it is unknown, or as bright as what is in front of it.
    """
    seen, is_background = brightness(spectra), alpha <= _TRANSPARENT
    background, foreground = seen[is_background], seen[~is_background]
    if len(background) == 0 or len(foreground) == 0:
        return None
    median = background.median()
    deviation = SIGMA_OF_MEDIAN_DEVIATION * (background - median).abs().median()
    level = float(median + _SIGMAS * deviation)
    return level if level < _DARK_SHARE * float(foreground.median()) else None


def alpha_confidence(
    spectra: Float[Tensor, "R B"], alpha: Float[Tensor, "R"], background: float | None
) -> Float[Tensor, "R"]:
    """Confidence in alpha, 0 or 1; `background` is as `background_level` gives it.

    0 where a pixel sends more light than its alpha lets through, and where alpha is above 0 and the light can't be
    distinguished from the background's.
    """
    if background is None:
        return torch.ones_like(alpha)
    seen = brightness(spectra)
    is_surplus = seen > background + alpha + _FAINTEST_SURPLUS
    is_nothing = (seen <= background) & (alpha > _TRANSPARENT)
    return (~(is_surplus | is_nothing)).to(alpha)


def may_show_foreground(
    spectra: Float[Tensor, "R B"], alpha: Float[Tensor, "R"], background: float | None
) -> Bool[Tensor, "R"]:
    """Pixels that may show something: by alpha where there is confidence in it, otherwise by their light. Arguments as
    above."""
    is_confident = alpha_confidence(spectra, alpha, background) > 0
    return torch.where(is_confident, alpha > 0, brightness(spectra) > (background or 0.0))


def exposure_of(pixels: Float[Tensor, "R B"]) -> float:
    """Factor that makes dark spectra as bright as those of a well exposed scene, by its opaque pixels; 1 to 100."""
    median = float(brightness(pixels).median()) if len(pixels) else _PLAIN_BRIGHTNESS
    return min(max(_PLAIN_BRIGHTNESS / max(median, 1e-9), 1.0), _LARGEST_EXPOSURE)


def relative_power_of(pixels: Float[Tensor, "R B"]) -> float:
    """Power of brightness by which squared errors should be divided, [0, 1.5], by how uneven its opaque pixels are.

    In most scenes the brighter tenth of the pixels is about twice as bright as the usual one, and absolute errors are
    right: 0. Where it is more than five times as bright, they would hardly tell of the dark rest: 1.5.
    """
    seen = brightness(pixels)
    if len(seen) == 0 or (median := float(seen.median())) <= 0:
        return 0.0
    brighter = float(seen.kthvalue(math.ceil(_BRIGHTER_PART * len(seen))).values)
    contrast = brighter / median
    return _LARGEST_POWER * min(max(math.log2(contrast / _PLAIN_CONTRAST), 0.0), 1.0)


def over_background(
    spectra: Float[Tensor, "*pixels B"],
    opacities: Float[Tensor, "*pixels"],
    background: Float[Tensor, "*pixels 1"],
) -> Float[Tensor, "*pixels B"]:
    """Spectra on black, premultiplied by their opacity, laid over a grey background."""
    return spectra + (1 - opacities)[..., None] * background


def mask_saturated(
    pred_spectra: Float[Tensor, "R B"], target_spectra: Float[Tensor, "R B"], measured: Float[Tensor, "R B"]
) -> Float[Tensor, "R B"]:
    """The prediction, but the target where it is brighter than a saturated sensor could measure."""
    return torch.where((measured >= 1) & (pred_spectra > target_spectra), target_spectra, pred_spectra)


def bounded_square(errors: Float[Tensor, "R C"], outliers: Float[Tensor, "R 1"]) -> Float[Tensor, "R C"]:
    """Squared errors up to a pixel's `outliers`; beyond, they grow in proportion, with the slope that they have there.

    Source: Huber, Ann. Math. Stat. 35(1), 1964.
    """
    size = errors.abs()
    return torch.where(size <= outliers, errors.square(), outliers * (2 * size - outliers))


def relative_weights(pred_spectra: Float[Tensor, "R B"], power: float) -> Float[Tensor, "R"]:
    """Weights of squared errors that fall with a power of the brightness of the rendered pixels, without gradient.

    The rendered pixel, not the measured one, so that noise of the latter does not decide how much it counts.

    Source: Mildenhall et al. 2022, NeRF in the Dark, for a power of 2.
    """
    return ((_PLAIN_BRIGHTNESS + _FAINT) / (brightness(pred_spectra.detach()) + _FAINT)) ** power


def solid_evidence(measured: Float[Tensor, "R B"]) -> Float[Tensor, "R"]:
    """How far a pixel's light says that it shows something solid, [0, 1]: in proportion to its brightness up to 0.05.

    A black pixel may show a black thing or nothing, such as what lies beside an open room.
    """
    return (brightness(measured) / _SURELY_LIT).clamp(max=1)
