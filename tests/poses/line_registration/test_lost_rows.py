"""Rows that are off by many pixels are found again from their neighbours."""

import torch

from tests.poses.line_registration.textured_plane import ROWS, error, swept, wobble
from unmix_plugin.poses.line_registration.lost_rows import Recovery, recover
from unmix_plugin.poses.line_registration.register import register
from unmix_plugin.poses.line_registration.swept_view import SweptView

_USUAL = 1e-4


def lost_from(knot: int, size_px: float) -> torch.Tensor:
    """The true wobble, but from some knot on far off."""
    steps = wobble(2.0)
    steps[knot:, 1] += size_px / 60.0
    return steps


def test_the_lower_rows_of_a_sweep_come_back() -> None:
    view = swept(wobble(2.0))
    start = lost_from(11, 9.0)
    found = recover(view, start, _USUAL)
    assert found.num_lost > 8
    assert found.is_better
    assert error(view, found.steps) < 0.1 * error(view, start)


def test_the_upper_rows_of_a_sweep_come_back() -> None:
    view = swept(wobble(2.0))
    start = wobble(2.0)
    start[:6, 0] -= 8.0 / 60.0
    found = recover(view, start, _USUAL)
    assert found.is_better
    assert error(view, found.steps) < 0.1 * error(view, start)


def test_a_sweep_that_is_right_is_left_alone() -> None:
    view = swept(wobble(2.0))
    found = recover(view, wobble(2.0), _USUAL)
    assert (found.num_lost, found.is_better) == (0, False)
    assert bool((found.steps == wobble(2.0)).all())


def test_rows_are_looked_for_in_a_quarter_of_the_sweeps_those_with_most_of_them_lost(monkeypatch) -> None:
    near = wobble(2.3)
    starts = [near, lost_from(17, 9.0), near, lost_from(11, 9.0), near, lost_from(14, 9.0), near, near]
    looked_for = []

    def watched(_view: SweptView, steps: torch.Tensor, _usual: float) -> Recovery:
        looked_for.append(next(i for i, start in enumerate(starts) if start is steps))
        return Recovery(steps, 0, is_better=False)

    monkeypatch.setattr("unmix_plugin.poses.line_registration.register.recover", watched)
    register([swept(wobble(2.0)) for _ in starts], starts)
    assert looked_for == [3, 5]


def test_a_sweep_without_a_run_of_good_rows_is_looked_for_around_its_given_poses() -> None:
    view = swept(wobble(6.0))
    start = wobble(6.0)
    start[:, 1] += 15.0 / 60.0
    found = recover(view, start, _USUAL)
    assert found.num_lost > ROWS // 3
    assert found.is_better
    assert error(view, found.steps) < 0.1 * error(view, start)


def test_what_no_pose_explains_is_not_taken_for_better() -> None:
    view = swept()
    generator = torch.Generator().manual_seed(0)
    view.wanted[40:56, :, :2] = torch.rand(16, 48, 2, generator=generator)
    start = torch.zeros(view.num_knots, 6, dtype=torch.float64)
    found = recover(view, start, _USUAL)
    assert found.num_lost > 0
    assert error(view, found.steps) <= error(view, start)
