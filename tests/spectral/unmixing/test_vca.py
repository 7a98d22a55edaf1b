import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.spectral.mixtures import mixed_pixels, seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.vca_nascimento2005 import estimate_snr_db, vca

HIGH_SNR_DB, LOW_SNR_DB = 80.0, 5.0


def scene(num_endmembers, shading_seed=None):
    """Mixtures with one pure pixel a material at known places, shaded if asked."""
    endmembers = smooth_endmembers(num_endmembers)
    pixels = mixed_pixels(endmembers, 500, seed=1)
    places = torch.arange(num_endmembers) * 61 + 17
    pixels[places] = endmembers
    if shading_seed is not None:
        shading = 0.1 + 0.9 * torch.rand(500, 1, dtype=torch.float64, generator=seeded(shading_seed))
        pixels = pixels * shading
    return pixels, places


@given(st.integers(2, 7), st.integers(0, 1000), st.sampled_from([HIGH_SNR_DB, LOW_SNR_DB]))
def test_pure_pixels_of_noiseless_mixtures_are_found_exactly_by_both_projections(
    num_endmembers, seed, snr_db
):
    pixels, places = scene(num_endmembers)
    result = vca(pixels, num_endmembers, seeded(seed), snr_db=snr_db)
    assert sorted(result.indices.tolist()) == places.tolist()
    assert_close(result.endmembers, pixels[result.indices], atol=1e-10, rtol=0)
    assert result.snr_db == snr_db


@given(st.integers(2, 6), st.integers(0, 1000))
def test_shading_does_not_hide_pure_pixels_from_the_perspective_projection(num_endmembers, seed):
    pixels, places = scene(num_endmembers, shading_seed=seed)
    assert sorted(vca(pixels, num_endmembers, seeded(seed)).indices.tolist()) == places.tolist()


def test_the_two_projections_differ_where_shading_bends_the_simplex():
    # One dark pixel is a corner of the unscaled data, and no corner once brightness is divided out.
    pixels, _ = scene(3)
    pixels[5] = 0.02 * pixels[6]
    assert 5 in vca(pixels, 3, seeded(), snr_db=LOW_SNR_DB).indices
    assert 5 not in vca(pixels, 3, seeded(), snr_db=HIGH_SNR_DB).indices


def test_the_branch_changes_at_15_plus_10_log10_k():
    pixels, _ = scene(3)
    pixels[5] = 0.02 * pixels[6]
    threshold = 15 + 10 * math.log10(3)
    assert 5 in vca(pixels, 3, seeded(), snr_db=threshold - 0.01).indices
    assert 5 not in vca(pixels, 3, seeded(), snr_db=threshold + 0.01).indices


@pytest.mark.parametrize("true_db", [10.0, 25.0, 40.0])
def test_snr_of_known_noise_is_estimated(true_db):
    pixels = mixed_pixels(smooth_endmembers(4, 60), 20_000, seed=3)
    noise = torch.randn(pixels.shape, generator=seeded(1), dtype=torch.float64)
    noise *= math.sqrt(float(pixels.square().mean()) / 10 ** (true_db / 10))
    assert abs(estimate_snr_db(pixels + noise, 4) - true_db) < 0.3


def test_snr_without_noise_is_infinite():
    assert estimate_snr_db(mixed_pixels(smooth_endmembers(4), 500, seed=3), 4) == math.inf


def test_projection_takes_noise_out_of_the_chosen_pixels():
    clean, places = scene(3)
    noisy = clean + 0.02 * torch.randn(clean.shape, generator=seeded(4), dtype=torch.float64)
    result = vca(noisy, 3, seeded())
    assert sorted(result.indices.tolist()) == places.tolist()
    truth = clean[result.indices]
    assert float((result.endmembers - truth).norm()) < 0.6 * float((noisy[result.indices] - truth).norm())


def test_the_generator_decides_everything():
    pixels = mixed_pixels(smooth_endmembers(5), 2000, seed=0)
    first, again = (vca(pixels, 5, seeded(7)).indices.tolist() for _ in range(2))
    assert first == again
    assert len({tuple(vca(pixels, 5, seeded(seed)).indices.tolist()) for seed in range(8)}) > 1


def test_endmembers_keep_the_type_of_the_pixels():
    pixels, places = scene(4)
    result = vca(pixels.float(), 4, seeded())
    assert result.endmembers.dtype == torch.float32
    assert sorted(result.indices.tolist()) == places.tolist()


def test_more_endmembers_than_the_pixels_span_are_refused():
    pixels = mixed_pixels(smooth_endmembers(3), 200, seed=0)
    with pytest.raises(SpectrumError, match="span only 3 dimensions: 5 endmembers were asked for"):
        vca(pixels, 5, seeded())


@pytest.mark.parametrize("num_endmembers", [1, 25])
def test_fewer_than_two_or_more_than_bands_are_refused(num_endmembers):
    pixels, _ = scene(3)
    with pytest.raises(SpectrumError, match=rf"between 2 and 24 .* {num_endmembers} were asked for"):
        vca(pixels, num_endmembers, seeded())
