"""Abundances of pixels whose endmembers are known: one convex problem a pixel, all pixels at once, in float64.

A pixel x is explained as E^T a (the paper's M is the transpose of E); `gram` is E E^T, so that half the squared error
is a . gram a / 2 - (E x) . a plus a constant. With all endmembers free to take part, a spectrum that is a little off is
explained by a mixture of many: white by a bit of every colour. In `sparse_abundances` a spectrum shows at most three
materials, and each beyond the first must bring it nearer by a fixed angle; brightness takes no part. Up to twelve
endmembers every choice of three is tried, which is exact; of more, the best sets found are extended one endmember at a
time.

Source: least squares with an l0 penalty, as in sparse unmixing (Iordache, Bioucas-Dias and Plaza 2011), whose l1
relaxation is needed only for libraries of hundreds. The extension is that of optimised orthogonal matching pursuit
(L. Rebollo-Neira and D. Lowe, IEEE Signal Processing Letters 9(4), 2002), with several sets kept.

Notation: `N` pixels, `B` bands, `K` endmembers, `C` choices of `m` endmembers, `S` sets kept a pixel.
"""

from __future__ import annotations

from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.errors import SpectrumError

_PIXELS_AT_A_TIME = 65_536
"""Pixels solved together, so that memory stays small: each needs K x K numbers."""
_SUM_WEIGHT = 1e3
"""How much heavier than a spectrum of the endmembers' length the sum-to-one row of `fcls` weighs."""
_MOST_MATERIALS, _SETS_KEPT = 3, 6
_MOST_SEARCHED = 12
"""Endmembers up to which all choices are tried."""
_NUMBERS_AT_A_TIME = 2_000_000
"""Bounds memory: spectra are taken in parts of so many candidate fits."""
_RIDGE = 1e-13
"""Added to the diagonal of normal equations, so that endmembers of one shape can be solved for."""


def nnls(pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "N K"]:
    """Non-negative least squares: the amounts a >= 0 that minimise |E^T a - x|.

    Amounts are not shares: they sum to a pixel's brightness, so divide by their sum. They are exact up to rounding,
    and of linearly dependent endmembers one solution is chosen. All values have to be finite.

    Source: Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23, each step for all pixels at once.
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

    Source: Heinz and Chang, IEEE TGRS 39(3), 2001: a heavy band, 1 in all spectra, enforces the sum.
    """
    _require_fitting(pixels, endmembers)
    # Of shares with sum 1, what all spectra have in common makes no difference; with it, small ones would drown in it.
    centre = endmembers.double().mean(dim=0)
    own, seen = endmembers.double() - centre, pixels.double() - centre
    weight = _SUM_WEIGHT * float(own.norm(dim=1).max().clamp(min=1e-12))
    spectra = torch.cat([own, torch.full_like(own[:, :1], weight)], dim=1)
    augmented = torch.cat([seen, torch.full_like(seen[:, :1], weight)], dim=1)
    shares = nnls(augmented, spectra)
    # The penalty leaves sums about 1e-6 off 1.
    return (shares / shares.sum(dim=1, keepdim=True).clamp(min=1e-12)).to(pixels.dtype)


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


def sparse_abundances(
    spectra: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"], mixing_penalty: float | Float[Tensor, ""]
) -> Float[Tensor, "N K"]:
    """Abundances of each spectrum, at least 0 with sum 1; zeros where a spectrum or what explains it is zero.

    A dark endmember must cover more than a bright one to send the same light. Each material beyond the first must
    improve the fit by an angle of which `mixing_penalty` is the sine.
    """
    corners = normalize(endmembers.double(), dim=1)
    gram = corners @ corners.T + _RIDGE * torch.eye(len(corners), dtype=torch.float64, device=corners.device)
    cosines = corners @ normalize(spectra.double(), dim=1).T
    search = _search_all if len(corners) <= _MOST_SEARCHED else _extend_best
    part = max(1, _NUMBERS_AT_A_TIME // (_SETS_KEPT * len(corners)))
    # `split` of no spectra gives one empty part.
    shares = torch.cat([search(some, gram, mixing_penalty) for some in cosines.split(part, dim=1)], dim=1)
    covered = shares.T / endmembers.double().norm(dim=1).clamp(min=1e-6)
    return (covered / covered.sum(dim=1, keepdim=True).clamp(min=1e-9)).to(spectra.dtype)


def _search_all(
    cosines: Float[Tensor, "K N"], gram: Float[Tensor, "K K"], mixing_penalty: float | Tensor
) -> Float[Tensor, "K N"]:
    """Shares of unit endmembers in the cheapest mixture of at most three."""
    # Spectra are columns here: what is done to every choice then runs along memory.
    smallest = torch.full_like(cosines[0], torch.inf)
    shares = torch.zeros_like(cosines)
    for choices in _choices(len(gram), cosines.device):
        price = mixing_penalty * (choices.shape[1] - 1)
        # The others are explained so well that even a perfect fit would cost more.
        open_to = (smallest > price).nonzero()[:, 0]
        misfit, found = _best_choice(cosines.index_select(1, open_to), gram, choices)
        before = smallest.index_select(0, open_to)
        cost = misfit + price
        better = cost < before
        smallest[open_to] = torch.where(better, cost, before)
        shares[:, open_to] = torch.where(better, found, shares.index_select(1, open_to))
    return shares


@cache
def _choices(num_endmembers: int, device: torch.device) -> list[Int[Tensor, "C m"]]:
    """All choices of one, two and three of the endmembers."""
    return [
        torch.combinations(torch.arange(num_endmembers, device=device), size)
        for size in range(1, min(num_endmembers, _MOST_MATERIALS) + 1)
    ]


def _best_choice(
    cosines: Float[Tensor, "K N"], gram: Float[Tensor, "K K"], choices: Int[Tensor, "C m"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, "K N"]]:
    """Sine of the angle to the best mixture of one of the choices with positive shares, and its shares.

    Infinite where no choice has only positive shares.
    """
    num_choices, size = choices.shape
    # By Cholesky factors what a nearly collinear endmember adds is one small square, not a difference of large numbers.
    factors = torch.linalg.cholesky(gram[choices[:, :, None], choices[:, None, :]])
    whitening = torch.linalg.solve_triangular(factors, torch.eye(size).to(factors), upper=False)
    whitened = whitening @ cosines.index_select(0, choices.flatten()).view(num_choices, size, -1)
    shares = whitening.mT @ whitened
    misfits = 1 - whitened.square().sum(dim=1)
    misfit, best = misfits.masked_fill_(shares.amin(dim=1) <= 0, torch.inf).min(dim=0)
    chosen = shares.gather(0, best.expand(1, size, -1))[0].clamp(min=0)
    return misfit.clamp(min=0).sqrt(), torch.zeros_like(cosines).scatter(0, choices[best].T, chosen)


def _extend_best(
    cosines: Float[Tensor, "K N"], gram: Float[Tensor, "K K"], mixing_penalty: float | Tensor
) -> Float[Tensor, "K N"]:
    """As `_search_all`, but only among extensions of the best sets of one endmember fewer."""
    loads = cosines.T.contiguous()
    sets = loads.topk(_SETS_KEPT, dim=1).indices[..., None]
    own = loads.gather(1, sets[:, 0]).clamp(min=0)
    smallest = (1 - own[:, 0].square()).clamp(min=0).sqrt()
    shares = torch.zeros_like(loads).scatter(1, sets[:, 0], own)
    rows = torch.arange(len(loads), device=loads.device)
    for size in range(2, _MOST_MATERIALS + 1):
        price = mixing_penalty * (size - 1)
        is_open = smallest[rows] > price
        rows = rows[is_open]
        misfit, found, sets = _extended(loads[rows], gram, sets[is_open])
        better = misfit + price < smallest[rows]
        smallest[rows[better]] = (misfit + price)[better]
        shares[rows[better]] = torch.zeros_like(loads[rows]).scatter(1, sets[:, 0], found)[better]
    return shares.T


def _extended(
    loads: Float[Tensor, "N K"], gram: Float[Tensor, "K K"], sets: Int[Tensor, "N S m"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N m+1"], Int[Tensor, "N S m+1"]]:
    """Best sets of one endmember more: sine of the angle to the first, its shares, and all, best first.

    By block elimination: what of a spectrum and of a new endmember the set leaves unexplained gives the new share.
    """
    num_kept, size = sets.shape[1:]
    # Where fewer sets fit than are kept, the rest repeat members, and their fits are not numbers.
    inverse = torch.linalg.inv_ex(gram[sets[..., :, None], sets[..., None, :]]).inverse
    own, across = loads.gather(1, sets.flatten(1)).view(sets.shape), gram[sets]
    alone, slopes = (inverse @ own[..., None])[..., 0], inverse @ across
    rest = loads[:, None] - (own[..., None] * slopes).sum(dim=2)
    new = rest / (1 + _RIDGE - (across * slopes).sum(dim=2)).clamp(min=_RIDGE)
    old = alone[..., None] - slopes * new[:, :, None]
    misfits = 1 - (own * alone).sum(dim=2)[..., None] - rest * new
    misfits.masked_fill_((new <= 0) | (old.amin(dim=2) <= 0), torch.inf).scatter_(2, sets, torch.inf)
    if size == 1:  # a pair is found from either end: only from the better one
        ends = torch.arange(num_kept, device=loads.device)
        ranks = torch.full_like(loads, torch.inf).scatter(
            1, sets[..., 0], ends.expand(len(sets), -1).to(loads)
        )
        misfits.masked_fill_(ranks[:, None] < ends[:, None], torch.inf)
    misfits.nan_to_num_(nan=torch.inf, posinf=torch.inf)
    best = misfits.flatten(1).topk(num_kept, largest=False, sorted=True)
    parents, added = best.indices // len(gram), best.indices % len(gram)
    grown = torch.cat([sets.gather(1, parents[..., None].expand(-1, -1, size)), added[..., None]], dim=2)
    rows = torch.arange(len(loads), device=loads.device)
    shares = torch.cat(
        [old[rows, parents[:, 0], :, added[:, 0]], new[rows, parents[:, 0], added[:, 0]][:, None]], dim=1
    )
    return best.values[:, 0].clamp(min=0).sqrt(), shares.clamp(min=0), grown
