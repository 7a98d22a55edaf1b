"""How many materials do these pixels show?

Two questions with two answers. HySime counts the dimensions of what is not noise: in linear mixtures the number of
materials, in pictures of surfaces also a highlight's colour and every colour that light takes on between surfaces.
The elbow asks how much each further material helps to explain pixels as mixtures of two, and ends where that is little;
it makes the proposal.

Notation: `N` pixels, `B` bands, `K` materials.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.subspace import estimate_noise
from unmix_plugin.spectral.unmixing.two_material_mixtures import two_material_fits

LEAST_BANDS = 8
"""By which noise is known: where materials are as many as bands, no band follows from the others, and signals count as
noise."""
_MOST_MATERIALS = 12
"""Largest number tried."""
_LEAST_SHARE, _LEAST_FALL = 0.2, 0.004
"""A further material must take away at least this share of the mean distance that is left, and at least so much of it:
about an angle in radians, a hundredth of that between common materials."""


@dataclass(frozen=True)
class _MaterialCount:
    """A proposed number of materials and the evidence for it."""

    number: int
    mean_distances: tuple[float, ...]
    """With 1, 2, ... materials: mean distance of pixels of length 1 to the nearest mixture of two of them, without what
    noise adds to it."""
    noise_distance: float
    """Mean distance that noise alone would make; 0 where there are too few pixels or bands to know it."""
    signal_dimensions: int | None
    """What HySime counts; None where there are too few pixels or bands for it."""

    def evidence(self) -> str:
        """Why this number, in a few lines for people."""
        lines = ["materials  distance left  taken away by the last one"]
        before = 1.0
        for number, distance in enumerate(self.mean_distances, start=1):
            mark = "  <- proposed" if number == self.number else ""
            lines.append(f"{number:9d}  {distance:13.4f}  {1 - distance / max(before, 1e-12):12.0%}{mark}")
            before = distance
        left_out = f"; noise, {self.noise_distance:.4f}, is left out" if self.noise_distance else ""
        lines.append(
            f"proposed: the last before one that takes away less than {_LEAST_SHARE:.0%} of the distance, or less than "
            f"{_LEAST_FALL:g}{left_out}"
        )
        if self.signal_dimensions is not None:
            lines.append(f"HySime: {self.signal_dimensions} dimensions hold more signal than noise")
        return "\n".join(lines)


def propose_num_materials(pixels: Float[Tensor, "N B"], generator: torch.Generator) -> _MaterialCount:
    """Number of materials from the elbow of the distance to mixtures of two, and HySime's count beside it, of pixels
    that are neither dark nor saturated, background left out."""
    num_pixels, num_bands = pixels.shape
    fits = two_material_fits(pixels, min(_MOST_MATERIALS, num_bands), generator)
    is_enough = num_bands >= LEAST_BANDS and num_pixels > num_bands
    noise = _noise_distance(pixels) if is_enough else 0.0
    # Distances in independent directions add as squares.
    distances = tuple(math.sqrt(max(fit.mean_distance**2 - noise**2, 0.0)) for fit in fits)
    return _MaterialCount(elbow(distances), distances, noise, hysime(pixels) if is_enough else None)


def elbow(mean_distances: tuple[float, ...]) -> int:
    """The number of materials after which a further one helps little, by the distances with 1, 2, ... of them.

    >>> elbow((0.20, 0.08, 0.03, 0.027, 0.026))
    3
    """
    number = 1
    for before, after in pairwise(mean_distances):
        if before - after < max(_LEAST_FALL, _LEAST_SHARE * before):
            break
        number += 1
    return number


def hysime(pixels: Float[Tensor, "N B"]) -> int:
    """Number of dimensions in which pixels of two bands or more, of which there are more than bands, hold more signal
    than noise.

    Source: J. M. Bioucas-Dias and J. M. P. Nascimento, "Hyperspectral Subspace Identification", IEEE TGRS 46(8), 2008,
    algorithms 1 and 2.
    """
    num_pixels, num_bands = pixels.shape
    if num_bands < 2 or num_pixels <= num_bands:
        raise SpectrumError(
            f"HySime needs at least two bands and more pixels than bands; found {num_pixels} pixels of "
            f"{num_bands} bands"
        )
    data = pixels.double()
    noise = estimate_noise(data)
    signal = data - noise
    correlation = data.T @ data / num_pixels
    noise_power = torch.diag((noise * noise).mean(dim=0))
    directions = torch.linalg.eigh(signal.T @ signal / num_pixels).eigenvectors
    power = (directions * (correlation @ directions)).sum(dim=0)
    # Leaving a direction out costs its signal and saves its noise (equation 20): it stays if that is a loss.
    costs = 2 * (directions * (noise_power @ directions)).sum(dim=0) - power
    # Without noise, what rounding leaves in a direction is not a signal.
    return int(((costs < 0) & (power > 1e-12 * power.sum())).sum())


def _noise_distance(pixels: Float[Tensor, "N B"]) -> float:
    """Mean distance that noise puts between a pixel of length 1 and the plane of two materials."""
    num_bands = pixels.shape[1]
    lengths = estimate_noise(pixels).norm(dim=1) / pixels.norm(dim=1)
    return float(lengths.double().mean()) * math.sqrt((num_bands - 2) / num_bands)
