"""How wide intervals are, by errors that were seen, and what errors of spectra become."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.intervals import (
    COVERAGES,
    Interval,
    propagated_deviation,
    width_factor,
    width_factors,
)


@given(st.integers(0, 20), st.integers(1, 5))
def test_of_a_linear_function_the_deviation_is_that_of_its_covariance(seed, count):
    generator = torch.Generator().manual_seed(seed)
    spectra, directions, matrix = (
        torch.randn(*shape, generator=generator, dtype=torch.float64)
        for shape in ((7, 6), (count, 6), (6, 2))
    )
    scales = torch.rand(7, generator=generator, dtype=torch.float64)
    found = propagated_deviation(lambda x: x @ matrix, spectra, directions, scales)
    covariance = matrix.T @ directions.T @ directions @ matrix
    expected = scales[:, None] * covariance.diagonal().sqrt()
    torch.testing.assert_close(found, expected)


def test_what_has_a_bound_is_not_taken_to_go_beyond_it():
    spectra = torch.tensor([[0.0], [5.0]])
    found = propagated_deviation(
        lambda x: x[..., 0].clamp(min=0), spectra, torch.tensor([[1.0]]), torch.ones(2)
    )
    torch.testing.assert_close(found, torch.tensor([0.5, 1.0]))


@pytest.mark.parametrize("draw", [torch.randn, torch.rand])
def test_so_many_errors_stay_below_a_width_as_its_coverage_says(draw):
    ratios = draw(40_000, generator=torch.Generator().manual_seed(0)).abs()
    factors = width_factors(ratios, torch.Generator().manual_seed(1))
    for coverage in (*COVERAGES, 0.85):
        assert float((ratios <= width_factor(factors, coverage)).double().mean()) == pytest.approx(
            coverage, abs=0.01
        )


@pytest.mark.parametrize("coverage", [0.0, 0.4, 0.999, 1.0, -1.0, float("nan")])
def test_a_coverage_that_was_not_counted_is_refused(coverage):
    with pytest.raises(ConfigError, match=r"expected 0\.5 to 0\.99"):
        width_factor(torch.ones(len(COVERAGES)), coverage)


def test_an_interval_that_is_unknown_says_why():
    unknown = Interval.unknown(np.zeros(3), 0.9, "nobody measured")
    assert np.isnan(unknown.width).all()
    assert unknown.not_determined == "nobody measured"
    assert not unknown.is_known


def test_an_endmember_whose_error_is_large_beside_it_has_no_interval_and_the_others_have():
    spectra, deviations = np.full((2, 4), 0.5), np.array([[0.02] * 4, [0.2] * 4])
    found = Interval.of_endmembers(spectra, deviations, 0.9)
    np.testing.assert_allclose(found.width[0], 2 * 1.645 * 0.02, rtol=1e-3)
    assert np.isnan(found.width[1]).all()
    assert found.is_known
    assert "none like it" in found.not_determined
    assert found.in_words("{:.2f}") == [*["0.47 to 0.53"] * 4, *["not determined"] * 4]
