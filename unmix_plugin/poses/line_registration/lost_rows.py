"""Rows whose pose has lost its way, found again from their neighbours.

Gradients draw a row to the nearest likeness, and a row that is off by ten pixels has another near. But next to rows
that are right a row is off by little, since what carries the camera moves smoothly. So from the longest run of rows
that look right, rows are fitted a few at a time, outwards, the others going on straight until their turn comes. Where
most rows are lost, they are looked for around the given poses (sought_rows.py).

Notation: as in swept_view.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.poses.line_registration.fit_rows import Fit, fit_rows
from unmix_plugin.poses.line_registration.sought_rows import sought
from unmix_plugin.poses.line_registration.swept_view import SweptView

LOST = 8.0
"""Mean squared error of a row over the usual one, from which it is lost."""
_LARGEST = 50.0
"""Beyond which it is not worse."""
FEWEST_LOST = 4
"""Rows, as many as lie between two knots: fewer are not worth the time."""
_FEWEST_ROWS = 12
"""In a run that tells where its neighbours are."""
_UNSURE_ROWS = 2
"""At each end of a run of rows that look right."""
_ROWS_A_TIME = 2
_ROWS_HELD = 14
"""Fitted together with those that join."""
_REACH, _ITERATIONS = 30.0, 4
_CLEARLY_BETTER = 0.9
"""Part of the former error below which what was found is taken."""


@dataclass(frozen=True)
class Recovery:
    """What came of a view whose rows were looked for."""

    steps: Float64[Tensor, "n 6"]
    num_lost: int
    """Rows that looked lost before."""
    is_better: bool
    """Whether the steps are others than before."""


def num_lost(errors: Float[Tensor, " H"], usual: float) -> int:
    """Rows that look lost, of their mean squared errors and that of a row that is right."""
    return int((errors > LOST * usual).sum())


def recover(view: SweptView, steps: Float64[Tensor, "n 6"], usual: float) -> Recovery:
    """Steps under which lost rows fit as well as others, if such are found.

    Args:
        view: Of a line camera.
        steps: As they are.
        usual: Mean squared error of a row that is right.
    """
    errors = view.row_errors(steps)
    lost = errors > LOST * usual
    shown = view.shows_matter
    good = ~lost
    good[: shown.start] = good[shown.stop :] = False
    run, count = _longest_run(good), int(lost.sum())
    if count < FEWEST_LOST:
        return Recovery(steps, count, is_better=False)
    if 2 * count <= len(lost) and run.stop - run.start >= _FEWEST_ROWS:
        found = track(view, steps, slice(run.start + _UNSURE_ROWS, run.stop - _UNSURE_ROWS), usual)
    else:
        found = sought(view, torch.zeros_like(steps))

    def mean_error(steps: Float64[Tensor, "n 6"]) -> float:
        return float(view.row_errors(steps).clamp(max=_LARGEST * usual).mean())

    is_better = mean_error(found) < _CLEARLY_BETTER * mean_error(steps)
    return Recovery(found if is_better else steps, count, is_better)


def track(view: SweptView, steps: Float64[Tensor, "n 6"], run: slice, usual: float) -> Float64[Tensor, "n 6"]:
    """Steps whose rows were fitted one after the other, outwards from some that are right.

    Args:
        view: Of a line camera.
        steps: As they are.
        run: Rows that are right.
        usual: Mean squared error of a row that is right.
    """
    shown, how = view.shows_matter, Fit(_ITERATIONS, _REACH, usual**0.5)
    found = _upwards(view, steps, run.start, shown.start, how)
    return _downwards(view, found, run.stop, shown.stop, how)


def _downwards(
    view: SweptView, steps: Float64[Tensor, "n 6"], row: int, end: int, how: Fit
) -> Float64[Tensor, "n 6"]:
    """Steps whose rows from `row` on were fitted one after the other, those beyond `end` going on straight."""
    first, _ = view.places()
    while True:
        rows = slice(max(row - _ROWS_HELD, 0), row)
        steps = fit_rows(view, steps, how, rows, slice(int(first[rows.start]) + 3, view.num_knots))
        if row >= min(end + _ROWS_A_TIME, len(first)):
            return steps
        row = min(row + _ROWS_A_TIME, len(first))


def _upwards(
    view: SweptView, steps: Float64[Tensor, "n 6"], row: int, end: int, how: Fit
) -> Float64[Tensor, "n 6"]:
    """The same towards the first row: `row` is the first of those that are right."""
    first, _ = view.places()
    while True:
        rows = slice(row, min(row + _ROWS_HELD, len(first)))
        steps = fit_rows(view, steps, how, rows, slice(0, int(first[rows.stop - 1]) + 1))
        if row <= max(end - _ROWS_A_TIME, 0):
            return steps
        row = max(row - _ROWS_A_TIME, 0)


def _longest_run(good: Bool[Tensor, " H"]) -> slice:
    """Of rows in a row."""
    edges = torch.cat([torch.zeros(1), good.float(), torch.zeros(1)]).diff()
    starts, stops = (edges > 0).nonzero()[:, 0], (edges < 0).nonzero()[:, 0]
    if len(starts) == 0:
        return slice(0, 0)
    best = int((stops - starts).argmax())
    return slice(int(starts[best]), int(stops[best]))
