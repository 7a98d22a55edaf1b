"""How far rendered spectra are from measured ones, over a common background.

Notation: `R` pixels, `B` bands.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.spectral.colour.conversion import linear_to_srgb


def over_background(
    spectra: Float[Tensor, "*pixels B"],
    opacities: Float[Tensor, "*pixels"],
    background: Float[Tensor, "*pixels 1"],
) -> Float[Tensor, "*pixels B"]:
    """Spectra on black, premultiplied by their opacity, laid over a grey background."""
    return spectra + (1 - opacities)[..., None] * background


def forgive_saturation(
    pred_spectra: Float[Tensor, "R B"], target_spectra: Float[Tensor, "R B"], measured: Float[Tensor, "R B"]
) -> Float[Tensor, "R B"]:
    """The prediction, but the target itself where the sensor was saturated and the prediction is brighter still.

    A measured 1 only says that the light was at least so strong.
    """
    return torch.where((measured >= 1) & (pred_spectra > target_spectra), target_spectra, pred_spectra)


def bounded_square(errors: Float[Tensor, "R C"], outliers: Float[Tensor, "R 1"]) -> Float[Tensor, "R C"]:
    """Squared errors up to a pixel's `outliers`; beyond, they grow in proportion, with the slope that they have there.

    Source: Huber, Ann. Math. Stat. 35(1), 1964.
    """
    size = errors.abs()
    return torch.where(size <= outliers, errors.square(), outliers * (2 * size - outliers))


_PLAIN_BRIGHTNESS = 0.2
"""Root mean square over bands of a pixel that keeps its weight."""
FAINT = 0.02
"""Brightness below which weights hardly grow: there is noise."""


def relative_weights(pred_spectra: Float[Tensor, "R B"], power: float) -> Float[Tensor, "R"]:
    """Weights of squared errors that fall with a power of the brightness of the rendered pixels, without gradient.

    The rendered pixel, not the measured one, so that noise of the latter does not decide how much it counts.

    Source: Mildenhall et al. 2022, NeRF in the Dark, for a power of 2.
    """
    brightness = pred_spectra.detach().square().mean(dim=-1).sqrt()
    return ((_PLAIN_BRIGHTNESS + FAINT) / (brightness + FAINT)) ** power


_SURELY_LIT = 0.05
"""Root mean square over bands from which a pixel surely shows something."""


def solid_evidence(measured: Float[Tensor, "R B"]) -> Float[Tensor, "R"]:
    """How far a pixel's light says that it shows something solid, [0, 1]: in proportion to its brightness up to 0.05.

    A black pixel may show a black thing or nothing, such as what lies beside an open room.
    """
    return (measured.square().mean(dim=-1).sqrt() / _SURELY_LIT).clamp(max=1)


def srgb_error(
    pred_spectra: Float[Tensor, "R B"],
    target_spectra: Float[Tensor, "R B"],
    rgb_weights: Float[Tensor, "B 3"],
    outliers: Float[Tensor, "R 1"],
) -> Float[Tensor, ""]:
    """Mean squared difference of the sRGB colours of two sets of spectra, bounded as `bounded_square` does.

    Against the colours of the measured spectra, not of a picture file: another colour pipeline than ours there would
    contradict the spectra.
    """
    colours = linear_to_srgb(torch.stack([pred_spectra, target_spectra]) @ rgb_weights)
    return bounded_square(colours[0] - colours[1], outliers).mean()
