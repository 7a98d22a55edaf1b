"""What measured spectra, unmixed one by one, say about the abundances of a field.

A rendered spectrum is never exact, and where endmembers resemble mixtures of each other a small error in a spectrum is
a large one in its mixture. Measured spectra are the better witnesses; a field that must agree with all of them takes
the mean over views, in which noise and highlights that wander over a surface lose.

Notation: `R` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels, shows_a_shape
from unmix_plugin.spectral.unmixing.sparse_unmixing import sparse_abundances
from unmix_plugin.spectral.unmixing.two_material_mixtures import mean_pair_distance

_PLAIN_UNEXPLAINED = 0.02
"""Mean angle, in radians, at which the mixing penalty is as many such angles as asked for. Of three scenes, two of
little coloured light leave 0.014 and 0.015, one whose walls colour each other 0.029."""
_MOST_STRICT = 1.5
"""Largest factor on that number: noise leaves angles too, and is no coloured light."""
_OBSERVED_PIXELS = 256
"""Pixels of a batch by which the error of leads is followed."""
_CLEAR_LEAD = 0.9
"""Lead from which on a pixel is left out of that: nearly pure ones hardly err, and would hide what the others do."""
_KEPT_A_STEP = 0.99
_SHARED_ERROR = 2.0
"""Variance of a lead's error in multiples of that of field against pixels: errors that both make aren't seen in it."""


class MixtureGuide(nn.Module):
    """Endmembers to unmix with, and how much a further material must explain to be believed; saved with the model."""

    endmembers: Tensor
    mixing_penalty: Tensor
    lead_variance: Tensor

    def __init__(self, num_endmembers: int, num_bands: int) -> None:
        super().__init__()
        self.register_buffer("endmembers", torch.zeros(num_endmembers, num_bands))
        self.register_buffer("mixing_penalty", torch.zeros(()))
        self.register_buffer("lead_variance", torch.full((), torch.inf))

    def start(
        self, pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"], relative_penalty: float
    ) -> None:
        """Unmix with these endmembers from now on.

        Args:
            pixels: Spectra of all training views.
            relative_penalty: The mixing penalty where mixtures of two materials leave a mean angle of 0.02 unexplained,
                in multiples of it. It grows with the square of the angle, up to 0.03, and then in proportion: light
                that is coloured by what it met before leaves more, and makes more mixtures that are none.
        """
        self.endmembers.copy_(endmembers)
        unexplained = mean_pair_distance(drop_uninformative_pixels(pixels), endmembers.to(pixels))
        strictness = min(unexplained / _PLAIN_UNEXPLAINED, _MOST_STRICT)
        self.mixing_penalty.fill_(relative_penalty * strictness * unexplained)

    def error(
        self, abundances: Float[Tensor, "R K"], measured: Float[Tensor, "R B"], alpha: Float[Tensor, "R"]
    ) -> Float[Tensor, ""]:
        """Mean squared distance of abundances to those of measured spectra; black and saturated ones say nothing.

        Args:
            abundances: Composited, so that they sum to the opacity.
            measured: Premultiplied by `alpha`.
        """
        mixtures = sparse_abundances(measured, self.endmembers, self.mixing_penalty)
        speaks = shows_a_shape(measured)
        if self.training:
            few = slice(_OBSERVED_PIXELS)
            self._follow_leads(abundances[few].detach(), mixtures[few], speaks[few] & (alpha[few] > 0.99))
        distances = (abundances - alpha[:, None] * mixtures).square().sum(dim=1)
        return (speaks * distances).mean()

    @property
    def lead_error(self) -> Float[Tensor, ""]:
        """Standard error of the lead of a ray's largest abundance over its second; infinite before any training."""
        return (_SHARED_ERROR * self.lead_variance).sqrt()

    def _follow_leads(
        self, abundances: Float[Tensor, "R K"], mixtures: Float[Tensor, "R K"], counts: Bool[Tensor, "R"]
    ) -> None:
        """Take in by how much leads differ from those of the measured spectra, a moving mean of the squares."""
        if abundances.shape[1] == 1:
            return
        leading = abundances.topk(2, dim=1)
        leads = leading.values[:, 0] - leading.values[:, 1]
        first, second = mixtures.gather(1, leading.indices).unbind(1)
        counts = counts & (leads < _CLEAR_LEAD)
        variance = (counts * (leads - first + second).square()).sum() / counts.sum().clamp(min=1)
        moved = torch.where(
            self.lead_variance.isinf(), variance, self.lead_variance.lerp(variance, 1 - _KEPT_A_STEP)
        )
        self.lead_variance.copy_(torch.where(counts.sum() > 0, moved, self.lead_variance))
