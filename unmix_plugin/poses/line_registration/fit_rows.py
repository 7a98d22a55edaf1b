"""Rows of a line camera, moved until a scene looks like what they measured.

Steps at knots are found by Levenberg-Marquardt steps on all pixels of the rows. All rows are moved by the same small
amount for each of the six numbers of a step, so twelve renders tell how each row changes with its own pose. Pixels that
fit far worse than others pull less (Huber).

Notation: as in swept_view.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.poses.line_registration.smooth_steps import SmoothPrior, solve_banded
from unmix_plugin.poses.line_registration.swept_view import SweptView

_DIFFERENCE_PX = 0.5
_DAMPING = 1e-4
_TRIES = 5
"""Dampings of a step that are tried, each ten times the one before."""
_NOTHING = 1e-4
"""Error and slope of a pixel below which it tells nothing."""
_MEDIAN_TO_DEVIATION = 1.48


@dataclass(frozen=True)
class Fit:
    """How rows are fitted."""

    iterations: int = 2
    reach: float = 3.0
    """Error from which a pixel pulls no more strongly, in standard deviations."""
    deviation: float | None = None
    """Standard deviation of a pixel's error; None: from the rows themselves."""
    blur: int = 1
    """Edge of the square of pixels over which pictures are averaged before they are compared, odd."""


def fit_rows(
    view: SweptView,
    steps: Float64[Tensor, "n 6"],
    how: Fit,
    rows: slice | None = None,
    knots: slice | None = None,
) -> Float64[Tensor, "n 6"]:
    """Steps after which rows look more like what was measured; as they were where none does.

    Args:
        view, how: What is fitted, and how.
        steps: Where to start.
        rows: Which are compared; None: all.
        knots: Which steps may change; None: all. The others hold their neighbours.
    """
    rows, knots = rows or slice(0, len(view.heights)), knots or slice(0, view.num_knots)
    prior, damping = SmoothPrior(view.num_knots, view.pixel), _DAMPING
    found = _residuals(view, steps, rows, how.blur)
    for _ in range(how.iterations):
        slopes = _slopes(view, steps, rows, how.blur)
        tells = (found.abs().amax(dim=-1) > _NOTHING) | (slopes.abs().amax(dim=(-2, -1)) > _NOTHING)
        if not bool(tells.any()):
            return steps
        errors = found.square().mean(dim=-1).sqrt()
        deviation = how.deviation or _MEDIAN_TO_DEVIATION * float(errors[tells].median()) + _NOTHING
        limit = how.reach * deviation
        blocks, pull = _equations(view, slopes, found, (limit / errors.clamp(min=limit)) / deviation**2, rows)
        prior.add_to(blocks)
        pull = pull + prior.slope(steps.numpy())
        cost = _cost(found, limit, deviation) + prior.cost(steps.numpy())
        for _ in range(_TRIES):
            change = solve_banded(blocks[:, knots], pull[knots], damping)
            tried = steps.clone()
            tried[knots] -= torch.from_numpy(change)
            seen = _residuals(view, tried, rows, how.blur)
            if _cost(seen, limit, deviation) + prior.cost(tried.numpy()) < cost:
                steps, found, damping = tried, seen, max(damping / 3, 1e-6)
                break
            damping *= 10
        else:
            return steps
    return steps


def fit_ever_sharper(
    view: SweptView,
    steps: Float64[Tensor, "n 6"],
    how: Fit,
    blurs: Sequence[int],
    rows: slice | None = None,
    knots: slice | None = None,
) -> Float64[Tensor, "n 6"]:
    """Steps fitted with one `blur` after the other. Other arguments as above."""
    for blur in blurs:
        steps = fit_rows(view, steps, replace(how, blur=blur), rows, knots)
    return steps


def _residuals(
    view: SweptView, steps: Float64[Tensor, "n 6"], rows: slice, blur: int
) -> Float64[Tensor, "h W D"]:
    return blurred(view.residuals(view.at_rows(steps)[None], rows), blur)[0].double()


def _slopes(
    view: SweptView, steps: Float64[Tensor, "n 6"], rows: slice, blur: int
) -> Float64[Tensor, "h W D 6"]:
    """How each pixel changes with the pose of its row, by central differences; where pictures are blurred, with the
    poses of the rows around it, since these move alike."""
    difference = _DIFFERENCE_PX * view.pixel
    moves = difference * torch.eye(6, dtype=torch.float64)
    here = view.at_rows(steps)
    ahead, behind = view.shown(here + torch.cat([moves, -moves])[:, None], rows).chunk(2)
    slopes = blurred((ahead - behind) / (2 * difference) * view.counts[rows], blur)
    return slopes.double().permute(1, 2, 3, 0)


def blurred(pictures: Float[Tensor, "m h W D"], edge: int) -> Float[Tensor, "m h W D"]:
    """Pictures averaged over squares of pixels of an odd edge."""
    if edge == 1:
        return pictures
    flat = pictures.permute(0, 3, 1, 2)
    return torch.nn.functional.avg_pool2d(flat, edge, 1, edge // 2, count_include_pad=False).permute(
        0, 2, 3, 1
    )


def _equations(
    view: SweptView,
    slopes: Float64[Tensor, "h W D 6"],
    found: Float64[Tensor, "h W D"],
    weights: Float64[Tensor, "h W"],
    rows: slice,
) -> tuple[Float64[np.ndarray, "4 n 6 6"], Float64[np.ndarray, "n 6"]]:
    """Normal equations of the knots: each row adds to the four that tell of it."""
    channels, count = found.shape[-1], view.num_knots
    weighed = slopes * (weights / channels)[..., None, None]
    normal = torch.einsum("hwdi,hwdj->hij", weighed, slopes)
    pull = torch.einsum("hwdi,hwd->hi", weighed, found)
    first, shares = (x[rows] for x in view.places())
    blocks, pulls = torch.zeros(4, count, 6, 6).double(), torch.zeros(count, 6).double()
    for low in range(4):
        pulls.index_add_(0, first + low, pull * shares[:, low, None])
        for high in range(low, 4):
            both = (shares[:, low] * shares[:, high])[:, None, None]
            blocks[high - low].index_add_(0, first + low, normal * both)
    return blocks.numpy(), pulls.numpy()


def _cost(found: Float[Tensor, "h W D"], limit: float, deviation: float) -> float:
    """Huber's sum over pixels, in variances."""
    errors = found.square().mean(dim=-1).sqrt()
    costs = torch.where(errors < limit, errors.square(), 2 * limit * errors - limit**2)
    return float(costs.sum()) / deviation**2
