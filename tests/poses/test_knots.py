import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from torch.testing import assert_close

from tests.factories.refined_cameras import corrections
from unmix_plugin.poses.knots import row_waves, spline_weights
from unmix_plugin.poses.refinement import PoseRefinement


def test_a_line_camera_is_corrected_by_waves_over_its_rows():
    found = PoseRefinement((0, 40, 0, 40, 20))
    firsts = [0, 1, 12, 13, 24]
    with torch.no_grad():
        found.steps[firsts] = torch.arange(1.0, 6.0)[:, None].expand(5, 6)
    counts = torch.tensor(found.knots.counts)
    # A frame camera goes the whole step, a line camera half of it.
    expected = torch.tensor([1.0, 1.0, 3.0, 2.0, 2.5]).repeat_interleave(counts)[:, None].expand(-1, 6)
    assert_close(corrections(found), expected)
    with torch.no_grad():
        found.steps.zero_()
        found.steps[14, 2] = 1.0
    half = corrections(found)[:, 2]
    assert_close(half[13:24] / half[13], torch.cos(torch.linspace(0, torch.pi, 11)))
    assert torch.equal(half[:13].abs().sum() + half[24:].abs().sum(), torch.tensor(0.0))


def dense_weights(place: torch.Tensor, count: int) -> torch.Tensor:
    """One row a place, one column a knot."""
    first, weights = spline_weights(place, torch.full_like(place, count, dtype=torch.int64))
    return torch.zeros(len(place), count).scatter(1, first[:, None] + torch.arange(4), weights)


def test_corrections_between_inner_knots_are_a_cubic_b_spline():
    place = torch.linspace(1.0, 7.0, 50)
    values = np.random.default_rng(0).normal(size=9)
    theirs = BSpline(np.arange(-2, 11), values, 3)(place.numpy())
    ours = dense_weights(place, 9).double() @ torch.from_numpy(values)
    assert_close(ours, torch.from_numpy(theirs), atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [4, 5, 9])
def test_a_straight_drift_stays_straight_up_to_both_ends(count):
    place = torch.linspace(0, count - 1, 40)
    assert_close(dense_weights(place, count) @ torch.arange(float(count)), place, atol=1e-5, rtol=0)
    assert_close(dense_weights(place, count).sum(dim=1), torch.ones(40))


def test_knots_follow_a_wobble_of_three_waves_of_10_px_within_a_fraction_of_a_pixel():
    y = torch.linspace(0.5, 95.5, 96)
    wobble = 10 * torch.sin(2 * torch.pi * 3 * y / 96 + 0.4)
    weights = dense_weights(y / 96 * 24, 25)
    fitted = weights @ torch.linalg.lstsq(weights, wobble[:, None]).solution
    assert float((fitted[:, 0] - wobble).square().mean().sqrt()) < 0.03


def test_a_bend_of_a_line_camera_costs_and_a_drift_does_not():
    found = PoseRefinement((0, 40, 40))

    def cost(*shapes: torch.Tensor) -> float:
        """Of corrections of the two sweeps; the frame has its own."""
        with torch.no_grad():
            found.steps.fill_(0.1)
            for first, shape in zip((1, 12), shapes, strict=True):
                found.steps[first : first + 11] = torch.linalg.solve(row_waves(11), shape)[:, None]
            of_size = 1e-3 * found.free_steps().square().mean()
            return float(found.penalty(found.free_steps())) - float(of_size)

    drift, bump = torch.linspace(0.0, 0.2, 11), torch.eye(11)[5] * 0.01
    assert cost(drift, -3 * drift + 0.5) < 1e-10
    # A bump bends by 1, -2 and 1 of its height; each sweep has 9 bends.
    assert abs(cost(drift + bump, drift) - 1.5 * 6 * 1e-4 / 18) < 1e-8


def test_a_sweep_that_goes_far_in_a_few_rows_is_not_undone_and_one_that_goes_far_in_all_is():
    found = PoseRefinement((40, 40, 40))
    few = torch.zeros(11)
    few[4:6] = 0.3
    with torch.no_grad():
        found.steps[:11, 0] = torch.linalg.solve(row_waves(11), few)
        found.steps[11, 0] = 0.3 / float(row_waves(11)[0, 0])
    found.restore_best()
    assert found.is_free.tolist() == [True, False, True]
