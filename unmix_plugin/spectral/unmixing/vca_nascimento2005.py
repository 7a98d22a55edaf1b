"""Vertex component analysis: pure pixels as the corners of the data's simplex.

Source: J. M. P. Nascimento and J. M. Bioucas-Dias, "Vertex Component Analysis: A Fast Algorithm to Unmix Hyperspectral
Data", IEEE TGRS 43(4), 2005, Algorithm 1.

Notation: `N` pixels, `B` bands, `K` endmembers, `d` dimensions kept. The paper stores pixels in columns; here bands
are last, so its U^T r is `pixels @ basis`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.errors import SpectrumError

_RANK_TOLERANCE = 1e-7
"""Relative length below which a direction left over after projection counts as none: the data have no more corners."""


@dataclass(frozen=True)
class _VcaResult:
    """What VCA found."""

    endmembers: Float[Tensor, "K B"]
    """Chosen pixels, projected onto the signal subspace (which takes most of the noise out of them)."""
    indices: Int[Tensor, " K"]
    """Which pixels were chosen, in the order of choice."""
    snr_db: float
    """Signal to noise ratio that decided the projection."""


def vca(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator, snr_db: float | None = None
) -> _VcaResult:
    """Find K corners of the data's simplex one by one, each the extreme pixel along a random direction orthogonal to
    those found.

    Above the threshold of 15 + 10 log10 K dB the pixels are scaled onto a plane (which removes shading); below it they
    are projected onto K - 1 principal components (which removes more noise).

    Args:
        pixels: Spectra in any unit. Drop dark ones first: the scaling divides by brightness.
        generator: On the CPU; the only source of randomness.
        snr_db: Signal to noise ratio in dB; None estimates it.
    Raises:
        SpectrumError: K below 2, above the bands or the pixels, or above the dimensions the pixels span.
    """
    _require_fitting(pixels, num_endmembers)
    data = pixels.double()
    if snr_db is None:
        snr_db = estimate_snr_db(data, num_endmembers)
    if snr_db < 15 + 10 * math.log10(num_endmembers):
        denoised, points = _project_orthogonally(data, num_endmembers)
    else:
        denoised, points = _project_perspectively(data, num_endmembers)
    indices = _extreme_points(points, generator)
    return _VcaResult(denoised[indices].to(pixels.dtype), indices, snr_db)


def estimate_snr_db(pixels: Float[Tensor, "N B"], num_endmembers: int) -> float:
    """Signal to noise ratio in dB, the power inside K principal dimensions against the rest; infinite without noise.

    Source:
        Nascimento and Bioucas-Dias 2005, equation 13, with the mean's power counted as signal.
    """
    data = pixels.double()
    num_bands = data.shape[1]
    mean = data.mean(dim=0)
    projected = (data - mean) @ _principal_basis(data - mean, num_endmembers)
    power = data.square().sum(dim=1).mean()
    signal_power = projected.square().sum(dim=1).mean() + mean.square().sum()
    noise_power = float(power - signal_power)
    excess_power = float(signal_power - num_endmembers / num_bands * power)
    # A remainder of rounding errors is not noise.
    if noise_power <= 1e-12 * float(power):
        return math.inf
    return 10 * math.log10(excess_power / noise_power) if excess_power > 0 else -math.inf


def _require_fitting(pixels: Tensor, num_endmembers: int) -> None:
    num_pixels, num_bands = pixels.shape
    if not 2 <= num_endmembers <= min(num_pixels, num_bands):
        raise SpectrumError(
            f"VCA finds between 2 and {min(num_pixels, num_bands)} endmembers in {num_pixels} pixels of "
            f"{num_bands} bands; {num_endmembers} were asked for"
        )


def _principal_basis(data: Tensor, num_dimensions: int) -> Float[Tensor, "B d"]:
    """Eigenvectors of the (uncentred) correlation matrix with the largest eigenvalues."""
    return torch.linalg.eigh(data.T @ data / len(data)).eigenvectors.flip(1)[:, :num_dimensions]


def _project_orthogonally(data: Tensor, num_endmembers: int) -> tuple[Tensor, Tensor]:
    """Lines 5-10: K - 1 principal components of the centred data, lifted by a constant K-th coordinate."""
    mean = data.mean(dim=0)
    basis = _principal_basis(data - mean, num_endmembers - 1)
    coordinates = (data - mean) @ basis
    radius = coordinates.norm(dim=1).max()
    lifted = torch.cat([coordinates, radius.expand(len(data), 1)], dim=1)
    return coordinates @ basis.T + mean, lifted


def _project_perspectively(data: Tensor, num_endmembers: int) -> tuple[Tensor, Tensor]:
    """Lines 11-16: K principal directions through the origin, each pixel scaled onto the plane x . mean(x) = 1."""
    basis = _principal_basis(data, num_endmembers)
    coordinates = data @ basis
    heights = coordinates @ coordinates.mean(dim=0)
    # A pixel at right angles to the mean has no place on the plane; 0 keeps it from being chosen.
    on_plane = torch.where(heights.abs() > 1e-12 * heights.abs().max(), 1 / heights, 0.0)
    return coordinates @ basis.T, coordinates * on_plane[:, None]


def _extreme_points(points: Float[Tensor, "N K"], generator: torch.Generator) -> Int[Tensor, " K"]:
    """Lines 17-25: indices of K points, each furthest along a random direction orthogonal to those before it."""
    num_endmembers = points.shape[1]
    chosen = points.new_zeros(num_endmembers, num_endmembers)
    chosen[-1, 0] = 1  # line 18: the first direction is orthogonal to the lifted axis
    indices = []
    for k in range(num_endmembers):
        direction = torch.randn(num_endmembers, generator=generator, dtype=torch.float64).to(points.device)
        direction = direction - chosen @ (torch.linalg.pinv(chosen) @ direction)
        extents = (points @ (direction / direction.norm())).abs()
        index = int(extents.argmax())
        if not extents[index] > _RANK_TOLERANCE * points.norm(dim=1).max():
            raise SpectrumError(
                f"the pixels span only {k} dimensions: {num_endmembers} endmembers were asked for; ask for at most {k}"
            )
        chosen[:, k] = points[index]
        indices.append(index)
    return torch.tensor(indices, device=points.device)
