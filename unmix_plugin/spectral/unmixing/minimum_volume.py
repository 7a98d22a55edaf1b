"""Minimum volume: the smallest simplex that holds nearly all pixels, where pure pixels may be missing.

Source: J. M. Bioucas-Dias, "A variable splitting augmented Lagrangian approach to linear spectral unmixing" (SISAL),
WHISPERS 2009: least -log|det Q| plus a hinge on negative abundances, so that a few outliers may stay outside. The
objective is that of the paper, with the hinge rounded near zero, which lets a quasi-Newton method minimise it.

Notation: `N` pixels, `B` bands, `K` endmembers. Pixels are scaled to sum 1, which removes shading, and lie near a plane
of K - 1 dimensions; `lifted` are their coordinates on it, a 1 in front. Abundances are `lifted @ Q`, the corners of the
simplex are the rows of the inverse of Q. Abundances sum to 1 if the columns of Q sum to (1, 0, ..., 0).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.nfindr_winter1999 import nfindr

_ROUNDING = 0.01
"""Abundance below which the hinge is a parabola."""

_HEAD_START = 1.2
"""How much larger than N-FINDR's simplex the first one is."""


def minimum_volume_simplex(
    pixels: Float[Tensor, "N B"],
    num_endmembers: int,
    generator: torch.Generator,
    outlier_penalty: float = 50.0,
    max_iterations: int = 200,
) -> Float[Tensor, "K B"]:
    """Corners of the smallest simplex around the shapes of the pixels, each with a sum over bands of 1.

    Args:
        pixels: Spectra of positive sum, in any unit. Drop dark ones first: noise is all the shape they have.
        generator: On the CPU; seeds the start, the only source of randomness.
        outlier_penalty: Price of a mean negative abundance, against the logarithm of the volume. Small values let many
            pixels stay outside, large ones reach for every noisy one: about K / penalty of them stay outside.
    Raises:
        SpectrumError: K below 2, above the bands or the pixels; pixels without light; a simplex that is flat.
    """
    sums = pixels.double().sum(dim=1, keepdim=True)
    if not bool((sums > 0).all()):
        raise SpectrumError(
            f"the minimum volume needs spectra of positive sum; found {int((sums <= 0).sum())} others"
        )
    shapes = pixels.double() / sums
    first = nfindr(shapes, num_endmembers, generator)
    mean, axes = _plane(shapes, num_endmembers - 1)
    lifted = _lift((shapes - mean) @ torch.linalg.pinv(axes))
    corners = _minimise(lifted, _enlarged(lifted[first]), outlier_penalty, max_iterations)
    spectra = (mean + corners[:, 1:] @ axes).clamp(min=0)
    return (spectra / spectra.sum(dim=1, keepdim=True)).to(pixels.dtype)


def _plane(
    shapes: Float[Tensor, "N B"], num_dimensions: int
) -> tuple[Float[Tensor, " B"], Float[Tensor, "D B"]]:
    """Mean, and principal axes as long as the spread along them."""
    mean = shapes.mean(dim=0)
    centred = shapes - mean
    eigen = torch.linalg.eigh(centred.T @ centred / len(shapes))
    spreads = eigen.eigenvalues.flip(0)[:num_dimensions].clamp(min=0).sqrt()
    return mean, (eigen.eigenvectors.flip(1)[:, :num_dimensions] * spreads).T


def _lift(coordinates: Float[Tensor, "N D"]) -> Float[Tensor, "N K"]:
    return torch.cat([torch.ones_like(coordinates[:, :1]), coordinates], dim=1)


def _enlarged(corners: Float[Tensor, "K K"]) -> Float[Tensor, "K K"]:
    centre = corners.mean(dim=0)
    return centre + _HEAD_START * (corners - centre)


def _minimise(
    lifted: Float[Tensor, "N K"], corners: Float[Tensor, "K K"], outlier_penalty: float, max_iterations: int
) -> Float[Tensor, "K K"]:
    """Lifted corners of the best simplex, found from the given ones."""
    unit = torch.eye(len(corners), dtype=lifted.dtype, device=lifted.device)[:, :1]
    free = torch.linalg.inv(corners)[:, :-1].contiguous().requires_grad_(True)
    optimizer = torch.optim.LBFGS(
        [free],
        max_iter=max_iterations,
        history_size=20,
        tolerance_change=1e-10,
        line_search_fn="strong_wolfe",
    )

    def objective() -> Tensor:
        optimizer.zero_grad()
        unmixing = torch.cat([free, unit - free.sum(dim=1, keepdim=True)], dim=1)
        missing = (-(lifted @ unmixing)).clamp(min=0)
        hinge = torch.where(missing < _ROUNDING, missing.square() / (2 * _ROUNDING), missing - _ROUNDING / 2)
        loss = outlier_penalty * hinge.sum(dim=1).mean() - torch.linalg.slogdet(unmixing).logabsdet
        loss.backward()
        return loss

    with torch.enable_grad():
        optimizer.step(objective)  # type: ignore[arg-type] - the closure may return a tensor
    free = free.detach()
    return torch.linalg.inv(torch.cat([free, unit - free.sum(dim=1, keepdim=True)], dim=1))
