"""Rows looked for all around where they are thought to be, where no neighbours tell.

A few rows at a time are compared with the scene under turns of up to 18 pixels in both directions, and the best turns
are fitted, whatever was found for other rows. The smoothest way through all that fit then leads to the rows between.

Notation: as in swept_view.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.poses.line_registration.fit_rows import Fit, blurred, fit_ever_sharper
from unmix_plugin.poses.line_registration.smooth_steps import SmoothPrior
from unmix_plugin.poses.line_registration.swept_view import SweptView

_ROWS = 10
"""Looked for together."""
_FARTHEST_PX, _APART_PX = 18, 3
_AT_ONCE = 8
"""Turns that are rendered together."""
_BLUR = 5
"""Edge of the squares over which pictures are averaged where turns are compared, pixels."""
_BEST = 3
"""Turns that are fitted."""
_NEAR_BLURS, _WAY_BLURS = (5, 3, 1), (9, 5, 3, 1)
_HOW = Fit(iterations=5, reach=30.0)
_FITS = 8.0
"""Mean squared error over that of the places that fit well, up to which a place does."""
_WELL = 0.25
"""Part of the places that fit well."""


@dataclass(frozen=True)
class _Place:
    """Some rows, where they fit best."""

    knots: slice
    """That tell of these rows."""
    steps: Float64[Tensor, "k 6"]
    """Of these knots."""
    error: float
    """Mean squared."""


def sought(view: SweptView, steps: Float64[Tensor, "n 6"]) -> Float64[Tensor, "n 6"]:
    """Steps under which rows fit that were looked for around others; the same where the view shows nothing.

    Args:
        view: Of a line camera.
        steps: Around which to look.
    """
    shown = view.shows_matter
    if shown.stop - shown.start < _ROWS:
        return steps
    starts = {*range(shown.start, shown.stop - _ROWS, _ROWS), shown.stop - _ROWS}
    places = [_seek(view, steps, slice(row, row + _ROWS)) for row in starts]
    limit = _FITS * float(np.quantile([place.error for place in places], _WELL))
    found, is_known = steps.clone(), np.zeros(len(steps), dtype=bool)
    for place in sorted(places, key=lambda place: -place.error):
        if place.error <= limit:
            found[place.knots], is_known[place.knots] = place.steps, True
    prior = SmoothPrior(view.num_knots, view.pixel)
    found = torch.from_numpy(prior.smoothest(found.numpy(), ~is_known))
    return fit_ever_sharper(view, found, _HOW, _WAY_BLURS)


def _seek(view: SweptView, steps: Float64[Tensor, "n 6"], rows: slice) -> _Place:
    """Where some rows fit best, all of them turned by about as much."""
    first, _ = view.places()
    middle = (rows.start + rows.stop) // 2
    knots = slice(int(first[rows.start]), int(first[rows.stop - 1]) + 4)
    base, found = view.at_rows(steps)[middle], []
    for turn in _best_turns(view, base, rows):
        tried = steps.clone()
        tried[knots] = base + turn
        tried = fit_ever_sharper(view, tried, _HOW, _NEAR_BLURS, rows, knots)
        error = float(view.row_errors(tried)[rows].mean())
        # The outer knots tell of the outermost rows alone.
        inner = slice(knots.start + 1, knots.stop - 1)
        found.append(_Place(inner, tried[inner], error))
    return min(found, key=lambda place: place.error)


def _best_turns(view: SweptView, base: Float64[Tensor, "6"], rows: slice) -> Float64[Tensor, "m 6"]:
    """Turns, beside a step, under which rows look most like what was measured."""
    turns, errors = _turns(view, (rows.start + rows.stop) // 2), []
    for some in turns.split(_AT_ONCE):
        moves = (base + some)[:, None].expand(-1, len(view.heights), -1)
        errors.append(blurred(view.residuals(moves, rows), _BLUR).square().mean(dim=(1, 2, 3)))
    return turns[torch.cat(errors).argsort()[:_BEST]]


def _turns(view: SweptView, row: int) -> Float64[Tensor, "m 6"]:
    """Turns of a row's camera that move what it sees along the row and across it, on a grid."""
    width = view.wanted.shape[1]
    own = view.rays[slice(row * width, (row + 1) * width)]
    assert own.axes is not None
    axis = own.axes[0].double().cpu()
    left, right = own.directions[[0, -1]].double().cpu()
    along = torch.nn.functional.normalize(right / (right @ axis) - left / (left @ axis), dim=0)
    across = torch.linalg.cross(axis, along)
    sizes = view.pixel * torch.arange(-_FARTHEST_PX, _FARTHEST_PX + 1, _APART_PX).double()
    a, b = torch.meshgrid(sizes, sizes, indexing="ij")
    turns: Float[Tensor, "m 3"] = a.reshape(-1, 1) * along + b.reshape(-1, 1) * across
    return torch.cat([turns, torch.zeros_like(turns)], dim=1)
