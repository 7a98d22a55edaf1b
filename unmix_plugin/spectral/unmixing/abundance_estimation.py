"""Abundances of pixels whose endmembers are known: one convex problem a pixel, all pixels at once.

Notation: `N` pixels, `B` bands, `K` endmembers (rows of `endmembers`, the paper's M is the transpose). A pixel x is
explained as E^T a; `gram` is E E^T, so that half the squared error is a . gram a / 2 - (E x) . a plus a constant.
Everything is computed in float64 and returned in the pixels' type.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.errors import SpectrumError

_PIXELS_AT_A_TIME = 65_536
"""Pixels solved together, so that memory stays small: each needs K x K numbers."""

_SUM_WEIGHT = 1e3
"""How much heavier than a spectrum of the endmembers' length the sum-to-one row of `fcls` weighs."""


def nnls(pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "N K"]:
    """Non-negative least squares: the amounts a >= 0 that minimise |E^T a - x|.

    Amounts are not shares: they sum to a pixel's brightness, so divide by their sum. They are exact up to rounding,
    and of linearly dependent endmembers one solution is chosen.

    Raises:
        SpectrumError: no endmember, or values that are not finite.
    Source:
        Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23, each step for all pixels at once.
    """
    _require_fitting(pixels, endmembers)
    spectra = endmembers.double()
    gram = spectra @ spectra.T
    parts = [_solve(part.double() @ spectra.T, gram) for part in pixels.split(_PIXELS_AT_A_TIME)]
    return torch.cat(parts).to(pixels.dtype) if parts else pixels.new_zeros(0, len(endmembers))


def fcls(pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "N K"]:
    """Fully constrained least squares: the shares a >= 0 of sum 1 that minimise |E^T a - x|.

    There is no shading in this model: a pixel in shadow is explained by dark endmembers. Scale pixels and endmembers
    to one brightness (such as a sum of 1) to ignore it.

    Raises:
        SpectrumError: as `nnls`.
    Source:
        Heinz and Chang, IEEE TGRS 39(3), 2001: a heavy band, 1 in all spectra, enforces the sum.
    """
    _require_fitting(pixels, endmembers)
    weight = _SUM_WEIGHT * float(endmembers.double().norm(dim=1).max().clamp(min=1e-12))
    spectra = torch.cat([endmembers.double(), torch.full_like(endmembers[:, :1], weight).double()], dim=1)
    augmented = torch.cat([pixels.double(), torch.full_like(pixels[:, :1], weight).double()], dim=1)
    shares = nnls(augmented, spectra)
    # The penalty leaves sums about 1e-6 off 1.
    return (shares / shares.sum(dim=1, keepdim=True).clamp(min=1e-12)).to(pixels.dtype)


def sunsal(
    pixels: Float[Tensor, "N B"],
    endmembers: Float[Tensor, "K B"],
    sparsity: float = 1e-3,
    max_iterations: int = 2000,
    tolerance: float = 1e-6,
) -> Float[Tensor, "N K"]:
    """Sparse amounts a >= 0 that minimise |E^T a - x|^2 / 2 + sparsity sum(a).

    Args:
        sparsity: Weight of the sum, in the unit of squared radiance.
        tolerance: Iteration ends when no amount differs by more between the two halves of the splitting, nor moves by
            more in a step, in units of the pixels' largest amount.
    Raises:
        SpectrumError: as `nnls`; a negative sparsity.
    Source:
        SUnSAL (constrained basis pursuit denoising by alternating directions), J. M. Bioucas-Dias and M. A. T.
        Figueiredo, WHISPERS 2010, algorithm 1 with the positivity constraint.
    """
    _require_fitting(pixels, endmembers)
    if sparsity < 0:
        raise SpectrumError(f"the sparsity weight must not be negative; found {sparsity:g}")
    spectra = endmembers.double()
    gram, loads = spectra @ spectra.T, pixels.double() @ spectra.T
    # The geometric mean of the extreme curvatures converges fastest on quadratics (Ghadimi et al., IEEE TAC 2015).
    curvatures = torch.linalg.eigvalsh(gram)
    top = curvatures[-1].clamp(min=1e-12)
    step = float((top * curvatures[0].clamp(min=1e-6 * top)).sqrt())
    inverse = torch.linalg.inv(gram + step * torch.eye(len(gram)).to(gram))
    split, dual = torch.zeros_like(loads), torch.zeros_like(loads)
    for _ in range(max_iterations):
        amounts = (loads + step * (split - dual)) @ inverse
        previous, split = split, (amounts + dual - sparsity / step).clamp(min=0)
        dual = dual + amounts - split
        moved = torch.maximum((split - previous).abs(), (split - amounts).abs())
        if len(moved) == 0 or float(moved.max()) <= tolerance * float(split.max().clamp(min=1e-12)):
            break
    return split.to(pixels.dtype)


def _solve(loads: Float[Tensor, "N K"], gram: Float[Tensor, "K K"]) -> Float[Tensor, "N K"]:
    """Amounts a >= 0 that minimise a . gram a / 2 - load . a for every row of loads."""
    num_pixels, num_endmembers = loads.shape
    amounts = torch.zeros_like(loads)
    in_use = torch.zeros_like(loads, dtype=torch.bool)
    enough = 1e-12 * float(gram.diagonal().max()) + 1e-11 * loads.abs().amax(dim=1)
    open_pixels = torch.arange(num_pixels, device=loads.device)
    # Each round takes one more endmember into use; far fewer than this are needed unless rounding makes a cycle.
    for _ in range(3 * num_endmembers):
        slopes = loads[open_pixels] - amounts[open_pixels] @ gram
        steepest = slopes.masked_fill(in_use[open_pixels], -torch.inf).max(dim=1)
        rising = steepest.values > enough[open_pixels]
        open_pixels = open_pixels[rising]
        if len(open_pixels) == 0:
            break
        in_use[open_pixels, steepest.indices[rising]] = True
        _constrained_step(open_pixels, amounts, in_use, loads, gram)
    return amounts


def _constrained_step(
    pixels: Tensor, amounts: Float[Tensor, "N K"], in_use: Bool[Tensor, "N K"], loads: Tensor, gram: Tensor
) -> None:
    """Bring `pixels` to the best amounts of the endmembers in use, dropping those that would turn negative."""
    for _ in range(gram.shape[0] + 1):
        used = in_use[pixels]
        best = _unconstrained(loads[pixels], used, gram)
        negative = used & (best <= 0)
        is_feasible = ~negative.any(dim=1)
        amounts[pixels[is_feasible]] = best[is_feasible]
        pixels, used, best, negative = (value[~is_feasible] for value in (pixels, used, best, negative))
        if len(pixels) == 0:
            return
        start = amounts[pixels]
        # As far along the way as all amounts stay above zero; the first to get there becomes zero.
        room = torch.where(negative, start / (start - best).clamp(min=1e-300), torch.inf)
        reached = room.amin(dim=1, keepdim=True).clamp(max=1)
        used = used & ~(negative & (room <= reached))
        amounts[pixels] = (start + reached * (best - start)).clamp(min=0) * used
        in_use[pixels] = used


def _unconstrained(loads: Tensor, used: Bool[Tensor, "N K"], gram: Tensor) -> Float[Tensor, "N K"]:
    """Least squares over the endmembers in use, 0 elsewhere."""
    mask = used.double()
    # A trace on the diagonal lets dependent endmembers be solved for; unused rows become those of the identity.
    trace = 1e-13 * gram.diagonal().max().clamp(min=1e-300)
    diagonal = torch.diag_embed(torch.where(used, trace, gram.diagonal().max().clamp(min=1e-300)))
    system = gram * mask[:, :, None] * mask[:, None, :] + diagonal
    return torch.linalg.solve(system, (loads * mask)[..., None])[..., 0] * mask


def _require_fitting(pixels: Tensor, endmembers: Tensor) -> None:
    if len(endmembers) == 0:
        raise SpectrumError("abundances need at least one endmember; found none")
    for what, values in (("pixels", pixels), ("endmembers", endmembers)):
        if not bool(torch.isfinite(values).all()):
            raise SpectrumError(f"the {what} hold NaN or infinite values; mask them out first")
