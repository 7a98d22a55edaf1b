"""Rows move until the scene looks like what they measured."""

import torch

from tests.poses.line_registration.textured_plane import ROWS, error, swept, wobble
from unmix_plugin.poses.line_registration.fit_rows import Fit, fit_rows
from unmix_plugin.poses.line_registration.register import register

_MANY = Fit(iterations=8)


def still(num_knots: int) -> torch.Tensor:
    return torch.zeros(num_knots, 6, dtype=torch.float64)


def test_a_wobble_of_a_pixel_is_found() -> None:
    view = swept(wobble(1.0))
    start = still(view.num_knots)
    found = fit_rows(view, start, _MANY)
    assert error(view, found) < 0.05 * error(view, start)


def test_rows_that_fit_stay_where_they_are() -> None:
    view = swept()
    found = fit_rows(view, still(view.num_knots), _MANY)
    assert float(found.abs().max()) < 0.02 * view.pixel


def test_knots_that_may_not_change_do_not() -> None:
    view = swept(wobble(1.0))
    found = fit_rows(view, still(view.num_knots), _MANY, slice(0, 20), slice(0, 6))
    assert bool((found[6:] == 0).all())
    assert bool((found[:6] != 0).any())


def test_pixels_that_are_left_out_do_not_pull() -> None:
    view = swept()
    view.wanted[20:30] = 1.0
    view.counts[20:30] = 0.0
    found = fit_rows(view, still(view.num_knots), _MANY)
    assert float(found.abs().max()) < 0.02 * view.pixel


def test_where_nothing_is_seen_nothing_moves() -> None:
    view = swept()
    view.wanted.zero_()
    empty = type(view)(
        view.rays,
        view.wanted,
        view.counts,
        view.heights,
        ROWS,
        view.distance,
        view.pixel,
        lambda rays: torch.zeros(len(rays), 3),
        has_opacity=True,
    )
    (found,) = register([empty], [still(view.num_knots)])
    assert bool((found == 0).all())


def test_views_are_registered_each_to_its_own_picture() -> None:
    views = [swept(wobble(0.7)), swept(wobble(-0.7)), swept()]
    starts = [still(view.num_knots) for view in views]
    found = register(views, starts)
    for view, own, start in zip(views[:2], found, starts, strict=False):
        assert error(view, own) < 0.2 * error(view, start)
    assert error(views[2], found[2]) < 1e-3
