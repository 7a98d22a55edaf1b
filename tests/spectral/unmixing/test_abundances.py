import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize
from torch.testing import assert_close

from tests.factories.mixtures import seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing import abundances as sparse_unmixing
from unmix_plugin.spectral.unmixing.abundances import fcls, nnls, sparse_abundances

SMOOTH = {count: smooth_endmembers(count).float() for count in range(1, 17)}


def random_problem(num_endmembers, num_pixels=40, num_bands=9, seed=0):
    """Endmembers and pixels that their mixtures do not reach, in float64."""
    generator = seeded(seed)
    endmembers = torch.rand(num_endmembers, num_bands, dtype=torch.float64, generator=generator)
    return torch.rand(num_pixels, num_bands, dtype=torch.float64, generator=generator), endmembers


@given(st.integers(1, 8), st.integers(0, 500))
def test_amounts_are_those_of_scipy(num_endmembers, seed):
    from scipy.optimize import nnls as scipy_nnls

    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    expected = np.stack([scipy_nnls(endmembers.numpy().T, pixel)[0] for pixel in pixels.numpy()])
    assert_close(nnls(pixels, endmembers), torch.from_numpy(expected), atol=1e-8, rtol=1e-8)


@given(st.integers(1, 8), st.floats(0.01, 100.0), st.integers(0, 500))
def test_no_small_allowed_change_of_amounts_is_better_and_they_grow_with_light(num_endmembers, gain, seed):
    pixels, endmembers = random_problem(num_endmembers, seed=seed)
    amounts = nnls(pixels, endmembers)
    slopes = (amounts @ endmembers - pixels) @ endmembers.T
    assert float(amounts.min()) >= 0
    assert float(slopes.min()) > -1e-8
    assert float((slopes * amounts).abs().max()) < 1e-8
    assert_close(nnls(gain * pixels, endmembers), gain * amounts, atol=1e-7 * gain, rtol=1e-6)


def test_mixtures_are_taken_apart_exactly():
    endmembers = smooth_endmembers(5)
    weights = torch.rand(200, 5, dtype=torch.float64, generator=seeded())
    weights[:100, :3] = 0
    assert_close(nnls(weights @ endmembers, endmembers), weights, atol=1e-8, rtol=0)
    shares = weights / weights.sum(1, keepdim=True)
    assert_close(fcls(shares @ endmembers, endmembers), shares, atol=1e-5, rtol=0)
    alike = endmembers[:1] * (1 + 0.003 * torch.randn(5, endmembers.shape[1], generator=seeded()))
    assert_close(fcls(shares @ alike, alike), shares, atol=1e-5, rtol=0)


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


@pytest.mark.parametrize("solve", [nnls, fcls])
def test_bad_input_is_refused_with_its_fault_and_none_gives_none(solve):
    pixels, endmembers = random_problem(3)
    with pytest.raises(SpectrumError, match="at least one endmember"):
        solve(pixels, endmembers[:0])
    with pytest.raises(SpectrumError, match="the pixels hold NaN"):
        solve(pixels / 0.0 * 0.0, endmembers)
    with pytest.raises(SpectrumError, match="the endmembers hold NaN"):
        solve(pixels, endmembers / 0.0)
    found = solve(pixels[:0].float(), endmembers.float())
    assert (found.shape, found.dtype) == ((0, 3), torch.float32)


def test_black_spectra_show_nothing_and_many_pixels_are_all_solved():
    pixels, endmembers = random_problem(2, num_pixels=7)
    assert not nnls(torch.zeros(3, 9), endmembers.float()).any()
    assert not sparse_abundances(torch.zeros(2, 9), endmembers.float(), 0.02).any()
    many = pixels.repeat(10_000, 1)  # more than are solved at a time
    assert_close(nnls(many, endmembers)[-7:], nnls(pixels, endmembers))


@pytest.mark.parametrize("num_endmembers", [1, 2, 3, 5, 25])
def test_pure_spectra_are_pure_under_any_shading(num_endmembers):
    endmembers = SMOOTH[num_endmembers] if num_endmembers < 10 else torch.eye(num_endmembers)
    shading = torch.linspace(0.1, 1.5, num_endmembers)[:, None]
    found = sparse_abundances(shading * endmembers, endmembers, 0.02)
    assert_close(found, torch.eye(num_endmembers), atol=1e-3, rtol=0)


@given(st.integers(0, 50), st.floats(0.2, 0.8))
@settings(max_examples=20)
def test_abundances_of_mixtures_of_two_are_found_whatever_the_brightness_of_endmembers(seed, share):
    endmembers = SMOOTH[5] * torch.rand(5, 1, generator=seeded(seed)).clamp(min=0.2)
    mixture = 0.4 * (share * endmembers[1] + (1 - share) * endmembers[3])
    found = sparse_abundances(mixture[None], endmembers, 1e-4)
    assert_close(found, torch.tensor([[0.0, share, 0.0, 1 - share, 0.0]]), atol=5e-3, rtol=0)


def test_spectra_show_at_most_three_materials_of_sum_one_and_none_that_explains_less_than_the_penalty():
    endmembers = SMOOTH[7]
    mixtures = torch.rand(200, 7, generator=seeded(1)) @ endmembers
    found = sparse_abundances(mixtures, endmembers, 0.001)
    assert_close(found.sum(dim=1), torch.ones(200))
    assert bool((found >= 0).all())
    assert int((found > 0).sum(dim=1).max()) <= 3
    nearly_pure = endmembers[:1] + 0.02 * endmembers[2:3]
    counts = [int((sparse_abundances(nearly_pure, endmembers, price) > 0).sum()) for price in (0.3, 0.0)]
    assert counts[0] == 1 < counts[1]


def test_the_same_endmember_twice_is_no_obstacle():
    pixels, endmembers = random_problem(3)
    twice = torch.cat([endmembers, endmembers])
    amounts = nnls(pixels, twice)
    assert float(amounts.min()) >= 0
    assert_close(amounts @ twice, nnls(pixels, endmembers) @ endmembers, atol=1e-6, rtol=0)
    assert_close(sparse_abundances(pixels, twice, 0.02).sum(dim=1), torch.ones(len(pixels)).double())


def test_nearly_collinear_greys_are_told_apart_as_far_as_float32_spectra_allow():
    generator = seeded(0)
    first = 0.2 + 0.6 * torch.rand(31, generator=generator, dtype=torch.float64)
    second = first * (1 + 1e-4 * torch.randn(31, generator=generator, dtype=torch.float64))
    shares = torch.rand(400, 1, generator=generator, dtype=torch.float64)
    mixtures = (shares * first + (1 - shares) * second).float()
    greys = torch.stack([first, second]).float()
    expected = nnls(mixtures.double(), greys.double())
    expected = expected / expected.sum(dim=1, keepdim=True)
    assert float((sparse_abundances(mixtures, greys, 0.0).double() - expected).abs().max()) < 0.01


def _cost(found, mixtures, endmembers, penalty):
    """What the search minimises, of each spectrum."""
    fitted = normalize(found.double() @ endmembers.double(), dim=1)
    cosines = (fitted * normalize(mixtures.double(), dim=1)).sum(dim=1)
    return (1 - cosines.square()).clamp(min=0).sqrt() + penalty * ((found > 0).sum(dim=1) - 1)


def _noisy_mixtures(endmembers, count=300):
    """Of one to three endmembers."""
    generator = seeded(4)
    places = torch.rand(count, len(endmembers), generator=generator).argsort(dim=1)[:, :3]
    is_in = torch.arange(count)[:, None] % 3 >= torch.arange(3)
    amounts = torch.rand(count, 3, generator=generator) * is_in
    clean = torch.zeros(count, len(endmembers)).scatter(1, places, amounts) @ endmembers
    return clean + 0.002 * torch.randn(clean.shape, generator=generator)


def test_few_endmembers_are_searched_wholly_and_extending_sets_finds_the_same(monkeypatch):
    endmembers = SMOOTH[5]
    mixtures = _noisy_mixtures(endmembers)
    whole = sparse_abundances(mixtures, endmembers, 0.01)
    monkeypatch.setattr(sparse_unmixing, "_MOST_SEARCHED", 0)
    monkeypatch.setattr(sparse_unmixing, "_SETS_KEPT", 5)
    assert_close(sparse_abundances(mixtures, endmembers, 0.01), whole, atol=1e-5, rtol=0)


def test_of_many_endmembers_nearly_every_spectrum_gets_the_mixture_of_the_whole_search(monkeypatch):
    endmembers = SMOOTH[16]
    mixtures = _noisy_mixtures(endmembers)
    screened = _cost(sparse_abundances(mixtures, endmembers, 0.01), mixtures, endmembers, 0.01)
    monkeypatch.setattr(sparse_unmixing, "_MOST_SEARCHED", 16)
    whole = _cost(sparse_abundances(mixtures, endmembers, 0.01), mixtures, endmembers, 0.01)
    assert bool((screened >= whole - 1e-6).all())
    assert float((screened < whole + 1e-6).double().mean()) > 0.95
    assert float(screened.mean()) < 1.02 * float(whole.mean())


def test_hundreds_of_endmembers_are_searched_in_bounded_parts(monkeypatch):
    endmembers = torch.rand(255, 40, generator=seeded(2)).square()
    mixtures = 0.7 * endmembers[:20] + 0.3 * endmembers[100:120]
    found = sparse_abundances(mixtures, endmembers, 0.001)
    assert_close(found.gather(1, torch.arange(20)[:, None])[:, 0], torch.full((20,), 0.7), atol=1e-3, rtol=0)
    monkeypatch.setattr(sparse_unmixing, "_NUMBERS_AT_A_TIME", 255 * 8 * 3)
    assert_close(sparse_abundances(mixtures, endmembers, 0.001), found)
