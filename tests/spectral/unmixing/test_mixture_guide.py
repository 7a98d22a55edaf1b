"""What measured spectra say of abundances: the loss, the penalty of further materials, and the error of margins."""

import torch
from torch.testing import assert_close

from tests.spectral.mixtures import seeded, smooth_endmembers
from unmix_plugin.spectral.unmixing.abundances import sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels, has_spectral_shape
from unmix_plugin.spectral.unmixing.mixture_guide import (
    MixtureCache,
    abundance_error,
    margin_error,
    margin_variance,
    mixing_penalty,
)
from unmix_plugin.spectral.unmixing.two_material_mixtures import mean_pair_distance

ENDMEMBERS = smooth_endmembers(4).float() * 0.8
UNKNOWN = torch.tensor(torch.inf)


def penalty(noise: float) -> float:
    pixels = torch.eye(4).repeat(30, 1) @ ENDMEMBERS
    pixels = pixels + noise * torch.rand(120, ENDMEMBERS.shape[1], generator=seeded(0))
    return mixing_penalty(pixels, ENDMEMBERS, 2.0)


def error(abundances: torch.Tensor, measured: torch.Tensor, alpha: torch.Tensor) -> float:
    mixtures = sparse_abundances(measured, ENDMEMBERS, penalty(0.0))
    return float(abundance_error(abundances, mixtures, alpha, has_spectral_shape(measured)))


def test_abundances_that_the_measured_spectra_show_are_no_error():
    assert error(torch.eye(4), 0.5 * ENDMEMBERS, torch.ones(4)) < 1e-6
    assert abs(error(torch.eye(4).roll(1, dims=1), 0.5 * ENDMEMBERS, torch.ones(4)) - 2.0) < 1e-2


def test_a_half_transparent_pixel_shows_half_of_its_mixture():
    alpha = torch.full((4,), 0.5)
    assert error(0.5 * torch.eye(4), 0.5 * ENDMEMBERS, alpha) < 1e-6
    assert error(torch.eye(4), 0.5 * ENDMEMBERS, alpha) > 0.1


def test_black_and_saturated_pixels_do_not_count():
    dark = torch.stack([torch.zeros_like(ENDMEMBERS[0]), torch.ones_like(ENDMEMBERS[0])])
    assert error(torch.rand(2, 4, generator=seeded(2)), dark, torch.ones(2)) == 0


def test_what_pairs_leave_unexplained_sets_the_penalty_of_further_materials():
    assert penalty(0.0) < 1e-3
    assert penalty(0.2) > penalty(0.05) > 1e-3


def test_the_penalty_grows_with_the_square_of_what_is_unexplained_and_then_in_proportion():
    off = torch.rand(120, ENDMEMBERS.shape[1], generator=seeded(0))
    seen = []
    for noise in (0.01, 0.02, 0.4):
        pixels = torch.eye(4).repeat(30, 1) @ ENDMEMBERS + noise * off
        angle = mean_pair_distance(drop_uninformative_pixels(pixels), ENDMEMBERS)
        seen.append(angle)
        expected = 100 * angle**2 if angle < 0.03 else 3 * angle
        assert_close(mixing_penalty(pixels, ENDMEMBERS, 2.0), expected, rtol=1e-4, atol=0)
    assert seen[0] < seen[1] < 0.03 < seen[2]


def observed(deviation: float, steps: int = 60, seed: int = 6) -> torch.Tensor:
    """The margin's variance after steps in which it is off by a normal error: two materials, one share too large."""
    variance = UNKNOWN
    for step in range(steps):
        generator = seeded(seed + step)
        share = 0.5 + 0.4 * torch.rand(200, 1, generator=generator)
        pure = torch.eye(4)[torch.randint(4, (200,), generator=generator)]
        mixed = share * pure + (1 - share) * pure.roll(1, dims=1)
        off = deviation / 2 * torch.randn(200, 1, generator=generator)
        abundances = mixed + off * (pure - pure.roll(1, dims=1))
        variance = margin_variance(variance, abundances, mixed, torch.ones(200, dtype=torch.bool))
    return variance


def test_the_error_of_margins_is_what_field_and_pixels_differ_by_widened_for_what_both_get_wrong():
    assert margin_error(UNKNOWN).isinf()
    small = float(margin_error(observed(0.02)))
    assert abs(small - 2**0.5 * 0.02) < 0.005
    assert float(margin_error(observed(0.2, steps=300))) > 3 * small


def test_pixels_that_do_not_count_leave_the_error_of_margins_unknown():
    even = torch.full((4, 4), 0.25)
    assert margin_variance(UNKNOWN, even, even, torch.zeros(4, dtype=torch.bool)).isinf()


def test_a_step_that_is_not_finite_leaves_the_error_of_margins_as_it_was():
    known, broken = observed(0.05, steps=3), torch.full((4, 4), torch.nan)
    assert_close(margin_variance(known, broken, torch.eye(4), torch.ones(4, dtype=torch.bool)), known)


def test_remembered_mixtures_are_those_computed_anew_whatever_shares_a_slot():
    cache = MixtureCache(4, torch.device("cpu"), num_slots=7)
    spectra = torch.rand(50, 4, generator=seeded(5)) @ ENDMEMBERS * 0.3
    for seed in range(20):
        pixels = torch.randint(50, (16,), generator=seeded(seed))
        found = cache.mixtures(pixels, spectra[pixels], ENDMEMBERS, torch.tensor(0.01))
        expected = sparse_abundances(spectra[pixels], ENDMEMBERS, 0.01)
        assert_close(found, expected, atol=1e-3, rtol=0)
        again = cache.mixtures(pixels, spectra[pixels], ENDMEMBERS, torch.tensor(0.01))
        assert torch.equal(found, again)
