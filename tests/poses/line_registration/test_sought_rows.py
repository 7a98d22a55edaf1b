"""Rows that are off by many pixels are found by looking all around."""

import torch

from tests.poses.line_registration.textured_plane import error, swept, wobble
from unmix_plugin.poses.line_registration.sought_rows import sought


def test_a_sweep_whose_rows_all_wobble_by_ten_pixels_is_found() -> None:
    view = swept(wobble(10.0))
    given = torch.zeros(view.num_knots, 6, dtype=torch.float64)
    assert error(view, given) > 0.1
    assert error(view, sought(view, given)) < 0.01


def test_rows_that_no_pose_explains_do_not_lead_the_others_astray() -> None:
    view = swept(wobble(6.0))
    generator = torch.Generator().manual_seed(0)
    view.wanted[30:38, :, :2] = torch.rand(8, 48, 2, generator=generator)
    found = sought(view, torch.zeros(view.num_knots, 6, dtype=torch.float64))
    errors = view.row_errors(found)
    assert float(errors[:24].max()) < 1e-3
    assert float(errors[44:].max()) < 1e-3


def test_a_view_that_shows_nothing_keeps_its_steps() -> None:
    view = swept(wobble(2.0))
    view.wanted.zero_()
    steps = wobble(1.0)
    assert torch.equal(sought(view, steps), steps)
