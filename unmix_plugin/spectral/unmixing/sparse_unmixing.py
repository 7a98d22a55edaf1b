"""Abundances of single spectra that are mixtures of few materials.

With all endmembers free to take part, a spectrum that is a little off is explained by a mixture of many: white by a
bit of every colour. A spectrum here shows at most three materials, and each beyond the first must bring it nearer by
a fixed angle. All choices of materials that could cost less than what was found are tried, which is exact; brightness
takes no part.

Source: least squares with an l0 penalty, as in sparse unmixing (Iordache, Bioucas-Dias and Plaza 2011), whose l1
relaxation is needed only for libraries of hundreds.

Notation: `N` spectra, `B` bands, `K` endmembers, `C` choices of `m` endmembers.
"""

from __future__ import annotations

from functools import cache
from math import comb

import torch
from jaxtyping import Float, Int
from torch import Tensor

_MOST_MATERIALS = 3
_MOST_CHOICES = 2000
"""Choices of endmembers that are tried: with more than 23 endmembers only pairs are."""

_RIDGE = 1e-6
"""Added to the diagonal of normal equations, so that endmembers of one shape can be solved for."""


def sparse_abundances(
    spectra: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"], mixing_penalty: float | Float[Tensor, ""]
) -> Float[Tensor, "N K"]:
    """Abundances of each spectrum, at least 0 with sum 1; zeros where a spectrum or what explains it is zero.

    Args:
        endmembers: Their brightness matters: a dark one must cover more than a bright one to send the same light.
        mixing_penalty: Sine of the angle by which each material beyond the first must improve the fit.
    """
    # Spectra are columns here: what is done to every choice then runs along memory.
    corners = torch.nn.functional.normalize(endmembers, dim=1)
    cosines, gram = corners @ torch.nn.functional.normalize(spectra, dim=1).T, corners @ corners.T
    smallest = torch.full_like(cosines[0], torch.inf)
    shares = torch.zeros_like(cosines)
    for choices in _choices(len(endmembers), cosines.device):
        price = mixing_penalty * (choices.shape[1] - 1)
        # The others are explained so well that even a perfect fit would cost more.
        open_to = (smallest > price).nonzero()[:, 0]
        misfit, found = _best_choice(cosines.index_select(1, open_to), gram, choices)
        before = smallest.index_select(0, open_to)
        cost = misfit + price
        better = cost < before
        smallest[open_to] = torch.where(better, cost, before)
        shares[:, open_to] = torch.where(better, found, shares.index_select(1, open_to))
    covered = shares.T / endmembers.norm(dim=1).clamp(min=1e-6)
    return covered / covered.sum(dim=1, keepdim=True).clamp(min=1e-9)


@cache
def _choices(num_endmembers: int, device: torch.device) -> list[Int[Tensor, "C m"]]:
    """All choices of one, two and three of the endmembers; of three only while they stay few."""
    return [
        torch.combinations(torch.arange(num_endmembers, device=device), size)
        for size in range(1, min(num_endmembers, _MOST_MATERIALS) + 1)
        if size <= 2 or comb(num_endmembers, size) <= _MOST_CHOICES
    ]


def _best_choice(
    cosines: Float[Tensor, "K N"], gram: Float[Tensor, "K K"], choices: Int[Tensor, "C m"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, "K N"]]:
    """Sine of the angle to the best mixture of one of the choices with positive shares, and its shares.

    Infinite where no choice has only positive shares.
    """
    num_choices, size = choices.shape
    among = gram[choices[:, :, None], choices[:, None, :]].double()
    inverse = torch.linalg.inv(among + _RIDGE * torch.eye(size, device=gram.device)).to(gram)
    own = cosines.index_select(0, choices.flatten()).view(num_choices, size, -1)
    shares = inverse @ own
    misfits = 1 - (shares * own).sum(dim=1)
    misfit, best = misfits.masked_fill_(shares.amin(dim=1) <= 0, torch.inf).min(dim=0)
    chosen = shares.gather(0, best.expand(1, size, -1))[0].clamp(min=0)
    return misfit.clamp(min=0).sqrt(), torch.zeros_like(cosines).scatter(0, choices[best].T, chosen)
