"""Endmembers as the corners of a simplex: of the pixels that stick out, or of the smallest one around nearly all.

VCA walks from corner to corner along random directions. N-FINDR swaps pixels until the simplex is largest; it starts
from VCA's rather than from random pixels, which saves most swaps. The simplex of minimum volume serves where pure
pixels are missing: there pixels are scaled to sum 1, which removes shading, abundances are `lifted @ Q`, the corners
are the rows of the inverse of Q, and abundances sum to 1 if the columns of Q sum to (1, 0, ..., 0).

Sources: J. M. P. Nascimento and J. M. Bioucas-Dias, "Vertex Component Analysis: A Fast Algorithm to Unmix Hyperspectral
Data", IEEE TGRS 43(4), 2005, Algorithm 1; M. E. Winter, "N-FINDR: an algorithm for fast autonomous spectral end-member
determination in hyperspectral data", Proc. SPIE 3753, 1999; J. M. Bioucas-Dias, "A variable splitting augmented
Lagrangian approach to linear spectral unmixing" (SISAL), WHISPERS 2009.

Notation: `N` pixels, `B` bands, `K` endmembers, `d` dimensions kept. `lifted` are a pixel's coordinates on K - 1
principal components, of one variance, with a 1 in front, so that K! times the volume of K pixels' simplex is
|det lifted|.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.errors import SpectrumError

_RANK_TOLERANCE = 1e-7
"""Relative length below which a direction left over after projection counts as none: the data have no more corners."""
_MOST_SWEEPS, _RESTARTS = 10, 5
"""Of N-FINDR: a sweep swaps each corner in turn."""
_LEAST_GAIN = 1e-9
"""Least relative growth of the volume that counts: rounding errors must not swap equal pixels forever."""
_OUTLIER_PRICE = 50.0
"""Of a mean negative abundance, against the logarithm of the volume: about K / 50 of the pixels stay outside."""
_ROUNDING = 0.01
"""Abundance below which its hinge is a parabola, which lets a quasi-Newton method minimise it."""
_HEAD_START = 1.2
"""How much larger than N-FINDR's simplex the first one is."""
_MOST_STEPS = 200


def vca(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator, snr_db: float | None = None
) -> tuple[Float[Tensor, "K B"], Int[Tensor, " K"]]:
    """K pixels one by one, each the extreme one along a random direction orthogonal to those found.

    Above the threshold of 15 + 10 log10 K dB the pixels are scaled onto a plane (which removes shading); below it they
    are projected onto K - 1 principal components (which removes more noise).

    Args:
        pixels: Spectra in any unit. Drop dark ones first: the scaling divides by brightness.
        snr_db: Signal to noise ratio in dB; None estimates it.
    Returns:
        The pixels without most of their noise, and which they are, in the order of choice.
    Raises:
        SpectrumError: K below 2, above the bands or the pixels, or above the dimensions the pixels span.
    """
    num_pixels, num_bands = pixels.shape
    if not 2 <= num_endmembers <= min(num_pixels, num_bands):
        raise SpectrumError(
            f"VCA finds between 2 and {min(num_pixels, num_bands)} endmembers in {num_pixels} pixels of "
            f"{num_bands} bands; {num_endmembers} were asked for"
        )
    data = pixels.double()
    if snr_db is None:
        snr_db = estimated_snr_db(data, num_endmembers)
    project = _on_components if snr_db < 15 + 10 * math.log10(num_endmembers) else _on_plane
    denoised, points = project(data, num_endmembers)
    indices = _extreme_points(points, generator)
    return denoised[indices].to(pixels.dtype), indices


def nfindr(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator
) -> Int[Tensor, " K"]:
    """Indices of the pixels whose simplex has (locally) the largest volume; the best of several restarts.

    Brightness counts: scale spectra to one brightness to ignore shading. Errors are those of `vca`, or that the pixels'
    simplex is flat in K - 1 dimensions.
    """
    lifted, _ = _lifted(pixels.double(), num_endmembers)
    runs = []
    for _ in range(_RESTARTS):
        # VCA on principal components (its branch for noise) starts with corners of a simplex that is not flat.
        indices = vca(pixels, num_endmembers, generator, snr_db=-math.inf)[1]
        for _ in range(_MOST_SWEEPS):
            before = indices
            for corner in range(len(indices)):
                indices = _with_best_corner(lifted, indices, corner)
            if torch.equal(before, indices):
                break
        runs.append(indices)
    return max(runs, key=lambda indices: float(torch.linalg.det(lifted[indices]).abs()))


def minimum_volume_simplex(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator
) -> Float[Tensor, "K B"]:
    """Corners of the smallest simplex around the shapes of the pixels, each with a sum over bands of 1.

    As SISAL, least -log|det Q| plus a hinge on negative abundances, so that a few outliers may stay outside. Of pixels
    in any unit that have light; drop dark ones first: noise is all the shape they have. Errors are those of `nfindr`.
    """
    sums = pixels.double().sum(dim=1, keepdim=True)
    if not bool((sums > 0).all()):
        raise SpectrumError(
            f"the minimum volume needs spectra of positive sum; found {int((sums <= 0).sum())} others"
        )
    shapes = pixels.double() / sums
    first = nfindr(shapes, num_endmembers, generator)
    lifted, axes = _lifted(shapes, num_endmembers)
    centre = lifted[first].mean(dim=0)
    corners = _least_volume(lifted, centre + _HEAD_START * (lifted[first] - centre))
    spectra = (shapes.mean(dim=0) + corners[:, 1:] @ axes).clamp(min=0)
    return (spectra / spectra.sum(dim=1, keepdim=True)).to(pixels.dtype)


def _least_volume(lifted: Float[Tensor, "N K"], corners: Float[Tensor, "K K"]) -> Float[Tensor, "K K"]:
    """Lifted corners of the best simplex, found from the given ones."""
    unit = torch.eye(len(corners), dtype=lifted.dtype, device=lifted.device)[:, :1]
    free = torch.linalg.inv(corners)[:, :-1].contiguous().requires_grad_(True)
    optimizer = torch.optim.LBFGS(
        [free], max_iter=_MOST_STEPS, history_size=20, tolerance_change=1e-10, line_search_fn="strong_wolfe"
    )

    def objective() -> Tensor:
        optimizer.zero_grad()
        unmixing = torch.cat([free, unit - free.sum(dim=1, keepdim=True)], dim=1)
        missing = (-(lifted @ unmixing)).clamp(min=0)
        hinge = torch.where(missing < _ROUNDING, missing.square() / (2 * _ROUNDING), missing - _ROUNDING / 2)
        loss = _OUTLIER_PRICE * hinge.sum(dim=1).mean() - torch.linalg.slogdet(unmixing).logabsdet
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(objective)  # type: ignore[arg-type] - the closure may return a tensor
    free = free.detach()
    return torch.linalg.inv(torch.cat([free, unit - free.sum(dim=1, keepdim=True)], dim=1))


def _lifted(data: Tensor, num_endmembers: int) -> tuple[Float[Tensor, "N K"], Float[Tensor, "d B"]]:
    """Lifted coordinates, and the K - 1 axes, as long as the spread along them."""
    centred = data - data.mean(dim=0)
    eigen = torch.linalg.eigh(centred.T @ centred / len(data))
    deviations = eigen.eigenvalues.flip(0)[: num_endmembers - 1].clamp(min=0).sqrt()
    least = 1e-7 * data.square().mean().sqrt()
    if not deviations[-1] > least:
        spanned = int((deviations > least).sum()) + 1
        raise SpectrumError(
            f"the pixels' simplex has only {spanned} corners: {num_endmembers} endmembers were asked for; "
            f"ask for at most {spanned}"
        )
    directions = eigen.eigenvectors.flip(1)[:, : num_endmembers - 1]
    components = centred @ directions / deviations
    return torch.cat([components.new_ones(len(data), 1), components], dim=1), (directions * deviations).T


def _with_best_corner(lifted: Tensor, indices: Tensor, corner: int) -> Tensor:
    """One corner swapped for the pixel that makes the volume largest.

    The determinant is linear in each row: with row `corner` replaced by x it is det(S) times column `corner` of
    inverse(S) . x, so one product gives the growth that every pixel would bring.
    """
    growth = (lifted @ torch.linalg.inv(lifted[indices])[:, corner]).abs()
    best = int(growth.argmax())
    if growth[best] <= 1 + _LEAST_GAIN:
        return indices
    replaced = indices.clone()
    replaced[corner] = best
    return replaced


def estimated_snr_db(data: Float[Tensor, "N B"], num_endmembers: int) -> float:
    """Signal to noise ratio in dB, the power inside K principal dimensions against the rest; infinite without noise.

    Nascimento and Bioucas-Dias 2005, equation 13, with the mean's power counted as signal.
    """
    mean = data.mean(dim=0)
    projected = (data - mean) @ _principal_basis(data - mean, num_endmembers)
    power = data.square().sum(dim=1).mean()
    signal_power = projected.square().sum(dim=1).mean() + mean.square().sum()
    noise_power = float(power - signal_power)
    excess_power = float(signal_power - num_endmembers / data.shape[1] * power)
    # A remainder of rounding errors is not noise.
    if noise_power <= 1e-12 * float(power):
        return math.inf
    return 10 * math.log10(excess_power / noise_power) if excess_power > 0 else -math.inf


def _principal_basis(data: Tensor, num_dimensions: int) -> Float[Tensor, "B d"]:
    """Eigenvectors of the (uncentred) correlation matrix with the largest eigenvalues."""
    return torch.linalg.eigh(data.T @ data / len(data)).eigenvectors.flip(1)[:, :num_dimensions]


def _on_components(data: Tensor, num_endmembers: int) -> tuple[Tensor, Tensor]:
    """Lines 5-10: K - 1 principal components of the centred data, lifted by a constant K-th coordinate."""
    mean = data.mean(dim=0)
    basis = _principal_basis(data - mean, num_endmembers - 1)
    coordinates = (data - mean) @ basis
    radius = coordinates.norm(dim=1).max()
    return coordinates @ basis.T + mean, torch.cat([coordinates, radius.expand(len(data), 1)], dim=1)


def _on_plane(data: Tensor, num_endmembers: int) -> tuple[Tensor, Tensor]:
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
