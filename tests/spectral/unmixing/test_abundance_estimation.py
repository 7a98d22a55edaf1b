import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.spectral.mixtures import seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.abundances import fcls, nnls, sunsal


def random_problem(num_endmembers, num_pixels=40, num_bands=9, seed=0):
    """Endmembers and pixels that their mixtures do not reach, in float64."""
    generator = seeded(seed)
    endmembers = torch.rand(num_endmembers, num_bands, dtype=torch.float64, generator=generator)
    return torch.rand(num_pixels, num_bands, dtype=torch.float64, generator=generator), endmembers


def objective(amounts, pixels, endmembers, sparsity=0.0):
    error = (amounts @ endmembers - pixels).square().sum(1)
    return error / 2 + sparsity * amounts.sum(1)


@given(st.integers(1, 8), st.integers(0, 500))
def test_amounts_are_those_of_scipy(num_endmembers, seed):
    from scipy.optimize import nnls as scipy_nnls

    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    expected = np.stack([scipy_nnls(endmembers.numpy().T, pixel)[0] for pixel in pixels.numpy()])
    assert_close(nnls(pixels, endmembers), torch.from_numpy(expected), atol=1e-8, rtol=1e-8)


@given(st.integers(1, 8), st.integers(0, 500))
def test_of_amounts_no_small_allowed_change_is_better(num_endmembers, seed):
    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    amounts = nnls(pixels, endmembers)
    slopes = (amounts @ endmembers - pixels) @ endmembers.T
    assert float(amounts.min()) >= 0
    assert float(slopes.min()) > -1e-8
    assert float((slopes * amounts).abs().max()) < 1e-8


@given(st.integers(2, 6), st.floats(0.01, 100.0), st.integers(0, 100))
def test_amounts_grow_with_brightness(num_endmembers, gain, seed):
    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    assert_close(
        nnls(gain * pixels, endmembers), gain * nnls(pixels, endmembers), atol=1e-7 * gain, rtol=1e-6
    )


def test_mixtures_are_taken_apart_exactly():
    endmembers = smooth_endmembers(5)
    weights = torch.rand(200, 5, dtype=torch.float64, generator=seeded())
    weights[:100, :3] = 0
    assert_close(nnls(weights @ endmembers, endmembers), weights, atol=1e-8, rtol=0)
    shares = weights / weights.sum(1, keepdim=True)
    assert_close(fcls(shares @ endmembers, endmembers), shares, atol=1e-5, rtol=0)


def test_the_same_endmember_twice_is_no_obstacle():
    pixels, endmembers = random_problem(3)
    twice = torch.cat([endmembers, endmembers])
    amounts = nnls(pixels, twice)
    assert float(amounts.min()) >= 0
    assert_close(amounts @ twice, nnls(pixels, endmembers) @ endmembers, atol=1e-6, rtol=0)


def test_black_pixels_hold_nothing():
    _, endmembers = random_problem(4)
    assert not nnls(torch.zeros(3, 9), endmembers.float()).any()


@pytest.mark.parametrize("solve", [nnls, fcls, sunsal])
def test_no_pixels_give_no_abundances_and_types_stay(solve):
    _, endmembers = random_problem(4)
    found = solve(torch.zeros(0, 9), endmembers.float())
    assert found.shape == (0, 4)
    assert found.dtype == torch.float32


@given(st.integers(1, 6), st.integers(0, 200))
def test_shares_lie_on_the_simplex_and_fit_no_worse_than_any_other_shares(num_endmembers, seed):
    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    shares = fcls(pixels, endmembers)
    assert float(shares.min()) >= 0
    assert_close(shares.sum(1), torch.ones(len(pixels), dtype=torch.float64))
    # Optimality over the simplex: no corner lies downhill.
    slopes = (shares @ endmembers - pixels) @ endmembers.T
    downhill = (shares * slopes).sum(1) - slopes.amin(1)
    assert float(downhill.max()) < 1e-4


def test_shading_misleads_shares_but_not_amounts():
    endmembers = torch.stack([torch.full((6,), 0.8), torch.full((6,), 0.1) + 0.02 * torch.arange(6)]).double()
    shaded = 0.3 * endmembers[:1]
    amounts = nnls(shaded, endmembers)
    assert_close(amounts, torch.tensor([[0.3, 0.0]], dtype=torch.float64), atol=1e-8, rtol=0)
    assert float(fcls(shaded, endmembers)[0, 1]) > 0.5


@given(st.integers(1, 6), st.integers(0, 100))
def test_without_a_price_sparse_amounts_are_least_squares(num_endmembers, seed):
    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    found = sunsal(pixels, endmembers, sparsity=0.0)
    assert float(found.min()) >= 0
    gap = objective(found, pixels, endmembers) - objective(nnls(pixels, endmembers), pixels, endmembers)
    assert float(gap.max()) < 1e-6


@given(st.integers(1, 6), st.floats(0.01, 0.5), st.integers(0, 100))
def test_sparse_amounts_are_optimal_for_their_price(num_endmembers, sparsity, seed):
    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    found = sunsal(pixels, endmembers, sparsity)
    slopes = (found @ endmembers - pixels) @ endmembers.T + sparsity
    assert float(found.min()) >= 0
    assert float(slopes.min()) > -1e-3
    assert float((slopes * found).abs().max()) < 1e-3


def test_a_higher_price_buys_less():
    pixels, endmembers = random_problem(5)
    sums = [float(sunsal(pixels, endmembers, price).sum()) for price in (0.0, 0.1, 0.5, 10.0)]
    assert sums[0] > sums[1] > sums[2] > sums[3] == 0


@pytest.mark.parametrize("solve", [nnls, fcls, sunsal])
def test_bad_input_is_refused_with_its_fault(solve):
    pixels, endmembers = random_problem(3)
    with pytest.raises(SpectrumError, match="at least one endmember"):
        solve(pixels, endmembers[:0])
    with pytest.raises(SpectrumError, match="the pixels hold NaN"):
        solve(pixels / 0.0 * 0.0, endmembers)
    with pytest.raises(SpectrumError, match="the endmembers hold NaN"):
        solve(pixels, endmembers / 0.0)


def test_a_negative_price_is_refused():
    pixels, endmembers = random_problem(3)
    with pytest.raises(SpectrumError, match=r"must not be negative; found -0\.1"):
        sunsal(pixels, endmembers, -0.1)


def test_more_pixels_than_are_solved_at_a_time_are_all_solved():
    pixels, endmembers = random_problem(2, num_pixels=7)
    many = pixels.repeat(10_000, 1)
    assert_close(nnls(many, endmembers)[-7:], nnls(pixels, endmembers))
