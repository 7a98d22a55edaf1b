"""Measured values and bands that are unreliable: stripes, spikes, dead bands, bands that are mostly noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine.sampling import SIGMA_OF_MEDIAN_DEVIATION
from unmix_plugin.spectral.evidence import brightness
from unmix_plugin.spectral.subspace import estimate_noise

FEWEST_BANDS, _PIXELS_PER_BAND = 8, 10
"""Least number of bands, and of pixels for each, from which noise can be estimated."""
_USUAL_SHARE, _USUAL_FACTOR = 0.95, 1.5
"""Deviations up to that multiple of what this share of the pixels has are usual."""
_LEAST_DEVIATION = 0.3
"""Of a bad value, as a share of the scene's median brightness."""
_PEAK = 1.2
"""By how much a bad value deviates more than the values in the bands beside it, which deviate because of it."""
_END_FACTOR = 0.75
"""Of a deviation at either end of the spectrum, from the one band beside it."""
REACH_PX = 2
"""Pixels around one that it is compared with."""
_MOST_ALIKE = 5
"""Of these 24, so many may deviate like a bad value, as those of its line do; at the corner of a real thing, 8 do."""
_PLAIN_FACTOR = 3.0
"""Noise up to this multiple of the usual band's weighs nothing down."""
_PLAIN_NOISE = 0.02
"""Share of the median brightness up to which a band counts as clean, whatever the others are."""
_NOISE_SHARE = 0.7
"""Standard deviation of noise, as a share of the band's own, above which a band is mostly noise."""
_DEAD_SPREAD, _LEAST_WEIGHT = 1e-5, 1e-4
"""Standard deviation up to which a band shows one value everywhere; and its weight, before weights are scaled."""


def deviations(spectra: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels B"]:
    """Of each value from the mean of the bands beside it; at the ends 0.75 of that from the one band beside it."""
    found = torch.empty_like(spectra)
    inner = found[..., 1:-1]  # filled in place: temporaries as large as an image took longer than the sums
    torch.add(spectra[..., :-2], spectra[..., 2:], out=inner)
    torch.add(spectra[..., 1:-1], inner, alpha=-0.5, out=inner)
    found[..., 0] = _END_FACTOR * (spectra[..., 0] - spectra[..., 1])
    found[..., -1] = _END_FACTOR * (spectra[..., -1] - spectra[..., -2])
    return found


def deviation_limits(pixels: Float[Tensor, "N B"]) -> Float[Tensor, "B"]:
    """Deviations from which a value may be bad, from at least one of the scene's spectra, background left out."""
    rank = min(max(1, round(_USUAL_SHARE * len(pixels))), len(pixels))
    usual = deviations(pixels).abs().kthvalue(rank, dim=0).values
    floor = _LEAST_DEVIATION * pixels.square().mean(dim=1).sqrt().median()
    return torch.maximum(_USUAL_FACTOR * usual, floor)


def repaired(
    image: Float[Tensor, "H W B"], limits: Float[Tensor, "B"], lines: range | None = None
) -> tuple[tuple[Int[Tensor, "values"], ...], Float[Tensor, "values"]]:
    """Rows, columns and bands of bad values, and what the bands beside them and the pixels around them say instead.

    Args:
        limits: As `deviation_limits` gives them.
        lines: Rows to look at, all by default. Those of a part of a larger image are `REACH_PX` from where it is cut.
    """
    lines = range(len(image)) if lines is None else lines
    found = deviations(image)
    inner = found[lines.start : lines.stop]
    # One number a pixel first: in a sound image this ends the search, and of few others all bands are looked at.
    is_suspect = inner.abs().sub_(limits).amax(dim=-1) > 0
    rows, columns = is_suspect.nonzero().unbind(dim=-1)
    size = inner[rows, columns].abs()
    beside = torch.nn.functional.pad(size, (1, 1))
    is_peak = size > _PEAK * torch.maximum(beside[..., :-2], beside[..., 2:])
    suspects, bands = (is_peak & (size > limits)).nonzero().unbind(dim=-1)
    rows, columns = rows[suspects] + lines.start, columns[suspects]
    around = _around(found, rows, columns, bands)
    differences = (found[rows, columns, bands][:, None] - around).abs().sort(dim=1).values
    kept = differences[:, _MOST_ALIKE] > limits[bands]
    excess = found[rows, columns, bands] - around.median(dim=1).values
    rows, columns, bands, excess = (part[kept] for part in (rows, columns, bands, excess))
    is_end = (bands == 0) | (bands == image.shape[-1] - 1)
    values = image[rows, columns, bands] - excess / torch.where(is_end, _END_FACTOR, 1.0)
    return (rows, columns, bands), values.clamp(0, 1)


def _around(
    found: Float[Tensor, "H W B"], rows: Int[Tensor, " C"], columns: Tensor, bands: Tensor
) -> Float[Tensor, "C 24"]:
    """Deviations in the same band of the pixels around candidates."""
    reach = torch.arange(-REACH_PX, REACH_PX + 1)
    shifts = torch.cartesian_prod(reach, reach)
    shifts = shifts[(shifts != 0).any(dim=1)]
    rows = _mirrored(rows[:, None] + shifts[:, 0], found.shape[0])
    columns = _mirrored(columns[:, None] + shifts[:, 1], found.shape[1])
    return found[rows, columns, bands[:, None]]


def _mirrored(places: Int[Tensor, "C 24"], size: int) -> Int[Tensor, "C 24"]:
    """Places within an image, mirrored at its first and last line so that no pixel is its own neighbour."""
    inside = places.abs()
    return torch.where(inside < size, inside, 2 * size - 2 - inside).clamp(0, size - 1)


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
    """Noise from what the other bands can't predict of a band, as HySime has it, but by median absolute deviations."""
    num_bands = pixels.shape[1]
    if num_bands < FEWEST_BANDS or len(pixels) < _PIXELS_PER_BAND * num_bands:
        return BandNoise.unknown(num_bands)
    dead = pixels.double().std(dim=0) <= _DEAD_SPREAD
    if int((~dead).sum()) < FEWEST_BANDS:
        return replace(BandNoise.unknown(num_bands), dead=dead)
    sigmas = pixels.new_zeros(num_bands)
    noise = estimate_noise(pixels[:, ~dead])
    sigmas[~dead] = (
        SIGMA_OF_MEDIAN_DEVIATION * (noise - noise.median(dim=0).values).abs().median(dim=0).values
    )
    usual = torch.maximum(sigmas[~dead].median(), _PLAIN_NOISE * brightness(pixels[:, ~dead]).median())
    weights = (_PLAIN_FACTOR * usual / sigmas.clamp(min=1e-12)).square().clamp(_LEAST_WEIGHT, 1.0)
    weights = torch.where(dead, _LEAST_WEIGHT, weights)
    if bool((weights < 1).any()):
        weights = weights / weights.mean()
    is_noise = (sigmas > _NOISE_SHARE * pixels.std(dim=0)) & (weights < 1) & ~dead
    return BandNoise(sigmas, weights, is_noise, dead)
