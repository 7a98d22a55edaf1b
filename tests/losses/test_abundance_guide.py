import torch
from torch.testing import assert_close

from tests.factories.mixtures import seeded, smooth_endmembers
from unmix_plugin.losses import abundance_guide
from unmix_plugin.losses.abundance_guide import AbundanceGuide, mixing_penalty
from unmix_plugin.losses.terms import LossTerm
from unmix_plugin.spectral.evidence import has_spectral_shape
from unmix_plugin.spectral.unmixing.abundances import nnls, sparse_abundances
from unmix_plugin.spectral.unmixing.two_material_mixtures import mean_pair_distance

ENDMEMBERS = smooth_endmembers(4).float() * 0.8


def noisy_pixels(noise):
    off = torch.rand(120, ENDMEMBERS.shape[1], generator=seeded(0))
    return torch.eye(4).repeat(30, 1) @ ENDMEMBERS + noise * off


def guide():
    found = AbundanceGuide(*ENDMEMBERS.shape)
    found.start(noisy_pixels(0.0), ENDMEMBERS, ENDMEMBERS)
    return found


def error(abundances, spectra, alpha=1.0):
    mixtures = alpha * guide().unmix(torch.arange(len(spectra)), spectra, ENDMEMBERS)
    weight = (has_spectral_shape(spectra)[:, None].to(mixtures),)
    return float(LossTerm(abundances, mixtures, weight, of_pixel="sum").loss())


def test_abundances_that_measured_spectra_show_are_no_error_and_black_and_saturated_pixels_do_not_count():
    assert error(torch.eye(4), 0.5 * ENDMEMBERS) < 1e-6
    assert abs(error(torch.eye(4).roll(1, dims=1), 0.5 * ENDMEMBERS) - 2.0) < 1e-2
    assert error(0.5 * torch.eye(4), 0.5 * ENDMEMBERS, 0.5) < 1e-6  # half transparent
    assert error(torch.eye(4), 0.5 * ENDMEMBERS, 0.5) > 0.1
    dark = torch.stack([torch.zeros_like(ENDMEMBERS[0]), torch.ones_like(ENDMEMBERS[0])])
    assert error(torch.rand(2, 4, generator=seeded(2)), dark) == 0


def tinted_pixels(strength):
    """Of one material each, lit in part by two others."""
    shares = torch.rand(300, 2, generator=seeded(3)) * strength
    own = torch.arange(300) % 4
    light = shares[:, :1] * ENDMEMBERS[(own + 1) % 4] + shares[:, 1:] * ENDMEMBERS[(own + 2) % 4]
    return ENDMEMBERS[own] + light


def beyond_pairs(pixels):
    """Mean angle by which mixtures of all come nearer than mixtures of two."""
    pixels, corners = (spectra / spectra.norm(dim=1, keepdim=True) for spectra in (pixels, ENDMEMBERS))
    to_all = (pixels - nnls(pixels, corners) @ corners).norm(dim=1)
    return mean_pair_distance(pixels, corners) - float(to_all.mean())


def test_what_all_materials_explain_beyond_pairs_sets_the_penalty_of_further_materials():
    """It grows with the square of that, and then in proportion."""
    seen = []
    for strength in (0.03, 0.06, 0.2):
        pixels = tinted_pixels(strength)
        gain = beyond_pairs(pixels)
        seen.append(gain)
        expected = 500 * gain**2 if gain < 0.01 else 5 * gain
        assert_close(mixing_penalty(pixels, ENDMEMBERS), expected, rtol=1e-2, atol=0)
    assert seen[0] < seen[1] < 0.01 < seen[2]
    assert mixing_penalty(noisy_pixels(0.0), ENDMEMBERS) < 1e-6


def test_noise_and_spectra_that_vary_set_no_penalty():
    """What they leave unexplained no further material explains."""
    pixels = noisy_pixels(0.05)
    assert mean_pair_distance(pixels, ENDMEMBERS) > 0.02
    assert mixing_penalty(pixels, ENDMEMBERS) < 0.1 * mixing_penalty(tinted_pixels(0.5), ENDMEMBERS)


def observed(deviation, steps=60):
    """A guide after steps in which margins are off by a normal error: two materials, one share too large."""
    found = guide()
    for step in range(steps):
        generator = seeded(6 + step)
        share = 0.5 + 0.4 * torch.rand(200, 1, generator=generator)
        pure = torch.eye(4)[torch.randint(4, (200,), generator=generator)]
        mixed = share * pure + (1 - share) * pure.roll(1, dims=1)
        off = deviation / 2 * torch.randn(200, 1, generator=generator)
        mixtures = found.unmix(200 * step + torch.arange(200), mixed @ ENDMEMBERS, ENDMEMBERS)
        counts = torch.ones(200, dtype=torch.bool)
        found.update(mixed + off * (pure - pure.roll(1, dims=1)), mixtures, counts)
    return found


def test_the_error_of_margins_is_what_field_and_pixels_differ_by_widened_for_what_both_get_wrong():
    assert guide().margin_error.isinf()
    small = float(observed(0.02).margin_error)
    assert abs(small - 2**0.5 * 0.02) < 0.005
    assert float(observed(0.2, steps=300).margin_error) > 3 * small


def test_what_does_not_count_or_is_not_finite_leaves_the_error_of_margins_as_it_was():
    known = observed(0.05, steps=3)
    before = known.margin_error.clone()
    even, pure, every = torch.full((4, 4), 0.25), torch.eye(4), torch.ones(4, dtype=torch.bool)
    known.update(even, pure, ~every)
    known.update(torch.nan * even, pure, every)
    assert torch.equal(known.margin_error, before)


def test_remembered_mixtures_are_those_computed_anew_whatever_shares_a_slot(monkeypatch):
    monkeypatch.setattr(abundance_guide, "_CACHE_BYTES", 7 * 8)
    cached = guide()
    spectra = torch.rand(50, 4, generator=seeded(5)) @ ENDMEMBERS * 0.3
    for seed in range(20):
        pixels = torch.randint(50, (16,), generator=seeded(seed))
        expected = sparse_abundances(spectra[pixels], ENDMEMBERS, cached.penalty)
        first, again = (cached.unmix(pixels, spectra[pixels], ENDMEMBERS) for _ in range(2))
        assert_close(first, expected, atol=1e-3, rtol=0)
        assert torch.equal(first, again)
