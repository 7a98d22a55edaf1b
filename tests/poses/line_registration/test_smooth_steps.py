"""Banded equations have the solution of dense ones, and smooth steps cost less."""

import numpy as np
import pytest

from unmix_plugin.poses.line_registration.smooth_steps import SmoothPrior, solve_banded


@pytest.mark.parametrize("num_knots", [4, 5, 9])
def test_the_banded_solution_is_the_dense_one(num_knots: int) -> None:
    generator = np.random.default_rng(0)
    blocks = np.zeros((4, num_knots, 6, 6))
    dense = np.zeros((num_knots, 6, num_knots, 6))
    for knot in range(num_knots - 3):
        rows = generator.normal(size=(30, 24))
        normal = (rows.T @ rows).reshape(4, 6, 4, 6)
        dense[knot : knot + 4, :, knot : knot + 4] += normal
        for low in range(4):
            for high in range(low, 4):
                blocks[high - low, knot + low] += normal[high, :, low]
    prior = SmoothPrior(num_knots, pixel=0.01)
    prior.add_to(blocks)
    dense += np.einsum("ab,ij->aibj", prior.matrix.toarray(), np.eye(6))
    pull = generator.normal(size=(num_knots, 6))
    matrix = dense.reshape(6 * num_knots, -1)
    matrix[np.diag_indices_from(matrix)] *= 1.01
    expected = np.linalg.solve(matrix, pull.ravel()).reshape(pull.shape)
    np.testing.assert_allclose(solve_banded(blocks, pull, 0.01), expected, rtol=1e-8, atol=1e-12)


def test_a_bend_costs_more_than_a_drift_and_a_drift_more_than_a_shift() -> None:
    prior = SmoothPrior(9, pixel=0.01)
    straight = np.linspace(0, 0.08, 9)[:, None] * np.ones(6)
    shifted = np.full((9, 6), straight.mean())
    bent = straight.copy()
    bent[4] += 0.01
    assert prior.cost(shifted) < prior.cost(straight) < prior.cost(bent)


def test_the_slope_is_half_of_the_gradient_of_the_cost() -> None:
    prior, generator = SmoothPrior(5, pixel=0.02), np.random.default_rng(1)
    steps, change = generator.normal(size=(2, 5, 6))
    difference = (prior.cost(steps + 1e-4 * change) - prior.cost(steps - 1e-4 * change)) / 2e-4
    assert difference == pytest.approx(2 * float((prior.slope(steps) * change).sum()), rel=1e-6)


def test_the_smoothest_steps_through_some_knots_cost_least() -> None:
    prior, generator = SmoothPrior(8, pixel=0.02), np.random.default_rng(2)
    steps, is_free = generator.normal(size=(8, 6)), np.isin(np.arange(8), [0, 3, 4])
    found = prior.smoothest(steps, is_free)
    np.testing.assert_array_equal(found[~is_free], steps[~is_free])
    for _ in range(5):
        change = generator.normal(size=(8, 6)) * is_free[:, None]
        assert prior.cost(found + 0.1 * change) > prior.cost(found)
    np.testing.assert_array_equal(prior.smoothest(steps, np.zeros(8, dtype=bool)), steps)
