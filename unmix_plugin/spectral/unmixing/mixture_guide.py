"""What measured spectra, unmixed one by one, say about the abundances of a field.

A rendered spectrum is never exact, and where endmembers resemble mixtures of each other a small error in a spectrum is
a large one in its mixture. Measured spectra are the better witnesses; a field that must agree with all of them takes
the mean over views, in which noise and highlights that wander over a surface lose.

Notation: `R` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.spectral.unmixing.abundances import sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels
from unmix_plugin.spectral.unmixing.two_material_mixtures import mean_pair_distance

_PLAIN_UNEXPLAINED = 0.02
"""Mean angle, in radians, at which the mixing penalty is as many such angles as asked for. Of three scenes, two of
little coloured light leave 0.014 and 0.015, one whose walls colour each other 0.029."""
_MOST_STRICT = 1.5
"""Largest factor on that number: noise leaves angles too, and is not coloured light."""
_CLEAR_MARGIN = 0.9
"""Nearly pure pixels, whose margin is larger, hardly err, and would hide what the others do."""
_DECAY = 0.99
_CACHE_BYTES = 1 << 26
_SHARED_ERROR = 2.0
"""Variance of a margin's error in multiples of that of field against pixels: errors of both cancel in it."""


def mixing_penalty(
    pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"], relative_penalty: float
) -> float:
    """By how many radians a further material must improve the fit of a spectrum to count.

    Args:
        pixels: Spectra of all training views.
        endmembers: To unmix with.
        relative_penalty: The penalty where mixtures of two materials leave a mean angle of 0.02 unexplained, in
            multiples of it. It grows with the square of the angle, up to 0.03, and then in proportion: light that is
            coloured by what it met before leaves more, and makes more mixtures that are none.
    """
    unexplained = mean_pair_distance(drop_uninformative_pixels(pixels), endmembers.to(pixels))
    return relative_penalty * min(unexplained / _PLAIN_UNEXPLAINED, _MOST_STRICT) * unexplained


def abundance_error(
    abundances: Float[Tensor, "R K"],
    mixtures: Float[Tensor, "R K"],
    alpha: Float[Tensor, "R"],
    is_informative: Bool[Tensor, "R"],
) -> Float[Tensor, ""]:
    """Mean squared distance of composited abundances to the mixtures of measured spectra.

    Args:
        abundances: Summing to the opacity.
        mixtures: Summing to 1.
        alpha: Measured opacity.
        is_informative: Pixels that are neither black nor saturated; others don't count.
    """
    distances = (abundances - alpha[:, None] * mixtures).square().sum(dim=1)
    return torch.where(is_informative, distances, 0.0).mean()


def margin_variance(
    before: Float[Tensor, ""],
    abundances: Float[Tensor, "R K"],
    mixtures: Float[Tensor, "R K"],
    counts: Bool[Tensor, "R"],
) -> Float[Tensor, ""]:
    """Moving mean of the squared difference of margins in the field from those of measured spectra.

    Args:
        before: The mean so far; infinite before the first pixels.
        abundances, mixtures: Of the field and of measured spectra.
        counts: Pixels to use. Without any, or where the field is not finite, the mean stays as it is.
    """
    if abundances.shape[1] == 1:
        return before
    largest = abundances.topk(2, dim=1)
    margins = largest.values[:, 0] - largest.values[:, 1]
    first, second = mixtures.gather(1, largest.indices).unbind(1)
    counts = counts & (margins < _CLEAR_MARGIN)
    errors = torch.where(counts, (margins - first + second).square(), 0.0)
    variance = errors.sum() / counts.sum().clamp(min=1)
    moved = torch.where(before.isinf(), variance, before.lerp(variance, 1 - _DECAY))
    return torch.where((counts.sum() > 0) & variance.isfinite(), moved, before)


def margin_error(variance: Float[Tensor, ""]) -> Float[Tensor, ""]:
    """Standard error of the margin of a ray's largest abundance over its second, from `margin_variance`."""
    return (_SHARED_ERROR * variance).sqrt()


class MixtureCache:
    """Mixtures of pixels that were unmixed recently: a mixture depends on the pixel alone, and pixels come again.

    A fixed number of slots, whatever the size of the scene; values are kept, and given even the first time, in half
    precision, so that a resumed training sees the same ones.
    """

    def __init__(self, num_endmembers: int, device: torch.device, num_slots: int | None = None) -> None:
        num_slots = min(1 << 20, _CACHE_BYTES // (2 * num_endmembers)) if num_slots is None else num_slots
        self._keys = torch.full((num_slots,), -1, dtype=torch.int64, device=device)
        self._values = torch.zeros(num_slots, num_endmembers, dtype=torch.float16, device=device)

    @torch.no_grad()
    def mixtures(
        self,
        pixels: Int[Tensor, "R"],
        spectra: Float[Tensor, "R B"],
        endmembers: Float[Tensor, "K B"],
        penalty: Tensor,
    ) -> Float[Tensor, "R K"]:
        """Abundances of measured spectra, summing to 1, as mixtures of few endmembers.

        Args:
            pixels: Number of each pixel, which stands for its spectrum.
            spectra: Their spectra; premultiplied ones too, since brightness does not matter.
            endmembers, penalty: As `sparse_abundances` takes them; the same in each call.
        """
        slots = pixels % len(self._keys)
        is_new = (self._keys[slots] != pixels).nonzero()[:, 0]
        values = self._values[slots]
        if len(is_new):
            found = sparse_abundances(spectra[is_new], endmembers, penalty).to(values)
            values[is_new] = found
            self._keys[slots[is_new]] = pixels[is_new]
            # Two pixels of a batch may share a slot; only one of them has it in the end.
            kept = is_new[self._keys[slots[is_new]] == pixels[is_new]]
            self._values[slots[kept]] = values[kept]
        return values.to(spectra)
