"""Stripes and spikes: values that stand out from the neighbouring bands, and from the neighbouring pixels in that.

A bad detector element makes a line of an image wrong in one band; a cosmic ray or a bit error, one value. A real
feature of a spectrum is seen in the pixels around it too, and the edge of a thing in the bands beside it. So a value
is bad if it deviates from the mean of the two bands beside it far more than other pixels' values of that band do, and
than those of the pixels around it. What spreads over two bands, or over two lines side by side, is not found.

Notation: `H x W` pixels, `B` bands, `C` candidates.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

FEWEST_BANDS = 8
USUAL_SHARE, USUAL_FACTOR = 0.95, 1.5
"""Deviations up to that multiple of what this share of the pixels has are usual."""
LEAST_DEVIATION = 0.3
"""Of a bad value, as a share of the scene's median brightness."""
_PEAK = 1.2
"""By how much a bad value deviates more than the values in the bands beside it, which deviate because of it."""
_END_FACTOR = 0.75
"""Of a deviation at either end of the spectrum, from the one band beside it."""
_REACH_PX = 2
"""Pixels around one that it is compared with."""
_MOST_ALIKE = 5
"""Of these 24, so many may deviate like a bad value, as those of its line do; at the corner of a real thing, 8 do."""


def deviations(spectra: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels B"]:
    """Of each value from the mean of the bands beside it; at the ends 0.75 of that from the one band beside it."""
    found = torch.empty_like(spectra)
    found[..., 1:-1] = spectra[..., 1:-1] - 0.5 * (spectra[..., :-2] + spectra[..., 2:])
    found[..., 0] = _END_FACTOR * (spectra[..., 0] - spectra[..., 1])
    found[..., -1] = _END_FACTOR * (spectra[..., -1] - spectra[..., -2])
    return found


def deviation_limits(pixels: Float[Tensor, "N B"]) -> Float[Tensor, "B"]:
    """Deviations from which a value may be bad.

    Args:
        pixels: Spectra of the scene, background left out; at least one.
    """
    rank = min(max(1, round(USUAL_SHARE * len(pixels))), len(pixels))
    usual = deviations(pixels).abs().kthvalue(rank, dim=0).values
    floor = LEAST_DEVIATION * pixels.square().mean(dim=1).sqrt().median()
    return torch.maximum(USUAL_FACTOR * usual, floor)


def repaired(
    image: Float[Tensor, "H W B"], limits: Float[Tensor, "B"]
) -> tuple[Bool[Tensor, "H W B"], Float[Tensor, "values"]]:
    """Which values of an image are bad, and what the bands beside them and the pixels around them say instead.

    Args:
        limits: As `deviation_limits` gives them.
    """
    found = deviations(image)
    size = found.abs()
    beside = torch.nn.functional.pad(size, (1, 1))
    is_peak = size > _PEAK * torch.maximum(beside[..., :-2], beside[..., 2:])
    candidates = (is_peak & (size > limits)).nonzero()
    rows, columns, bands = candidates.unbind(dim=-1)
    around = _around(found, candidates)
    differences = (found[rows, columns, bands][:, None] - around).abs().sort(dim=1).values
    kept = differences[:, _MOST_ALIKE] > limits[bands]
    excess = found[rows, columns, bands] - around.median(dim=1).values
    rows, columns, bands, excess = (part[kept] for part in (rows, columns, bands, excess))
    is_bad = torch.zeros_like(image, dtype=torch.bool)
    is_bad[rows, columns, bands] = True
    is_end = (bands == 0) | (bands == image.shape[-1] - 1)
    values = image[rows, columns, bands] - excess / torch.where(is_end, _END_FACTOR, 1.0)
    return is_bad, values.clamp(min=0)


def _around(found: Float[Tensor, "H W B"], candidates: Int[Tensor, "C 3"]) -> Float[Tensor, "C 24"]:
    """Deviations in the same band of the pixels around candidates."""
    reach = torch.arange(-_REACH_PX, _REACH_PX + 1)
    shifts = torch.cartesian_prod(reach, reach)
    shifts = shifts[(shifts != 0).any(dim=1)]
    rows = _mirrored(candidates[:, None, 0] + shifts[:, 0], found.shape[0])
    columns = _mirrored(candidates[:, None, 1] + shifts[:, 1], found.shape[1])
    return found[rows, columns, candidates[:, None, 2]]


def _mirrored(places: Int[Tensor, "C 24"], size: int) -> Int[Tensor, "C 24"]:
    """Places within an image, mirrored at its first and last line so that no pixel is its own neighbour."""
    inside = places.abs()
    return torch.where(inside < size, inside, 2 * size - 2 - inside).clamp(0, size - 1)
