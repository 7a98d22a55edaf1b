import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.mixtures import mixed_pixels, seeded, smooth_endmembers, worst_angle
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing import simplex_corners
from unmix_plugin.spectral.unmixing.simplex_corners import minimum_volume_simplex, nfindr, vca

HIGH_SNR_DB, LOW_SNR_DB = 80.0, 5.0


def scene(num_endmembers, shading_seed=None, mixtures_seed=1):
    """Mixtures with one pure pixel a material at known places, shaded if asked."""
    endmembers = smooth_endmembers(num_endmembers)
    pixels = mixed_pixels(endmembers, 500, seed=mixtures_seed)
    places = torch.arange(num_endmembers) * 61 + 17
    pixels[places] = endmembers
    if shading_seed is not None:
        shading = 0.1 + 0.9 * torch.rand(500, 1, dtype=torch.float64, generator=seeded(shading_seed))
        pixels = pixels * shading
    return pixels, places


@given(st.integers(2, 7), st.integers(0, 1000), st.sampled_from([HIGH_SNR_DB, LOW_SNR_DB]))
def test_pure_pixels_are_found_exactly_by_both_projections_shaded_ones_by_one(num_endmembers, seed, snr_db):
    pixels, places = scene(num_endmembers)
    found, indices = vca(pixels, num_endmembers, seeded(seed), snr_db=snr_db)
    assert sorted(indices.tolist()) == places.tolist()
    assert_close(found, pixels[indices], atol=1e-10, rtol=0)
    shaded, _ = scene(num_endmembers, shading_seed=seed)
    assert sorted(vca(shaded, num_endmembers, seeded(seed))[1].tolist()) == places.tolist()


def test_the_branch_changes_at_15_plus_10_log10_k():
    pixels, _ = scene(3)
    pixels[5] = 0.02 * pixels[6]
    threshold = 15 + 10 * math.log10(3)
    assert 5 in vca(pixels, 3, seeded(), snr_db=threshold - 0.01)[1]
    assert 5 not in vca(pixels, 3, seeded(), snr_db=threshold + 0.01)[1]


def test_noise_is_estimated_and_the_projection_takes_it_out_of_the_chosen_pixels():
    many = mixed_pixels(smooth_endmembers(4, 60), 20_000, seed=3)
    noise = torch.randn(many.shape, generator=seeded(1), dtype=torch.float64)
    for true_db in (10.0, 25.0, 40.0):
        scaled = noise * math.sqrt(float(many.square().mean()) / 10 ** (true_db / 10))
        assert abs(simplex_corners.estimated_snr_db(many + scaled, 4) - true_db) < 0.3
    assert simplex_corners.estimated_snr_db(many, 4) == math.inf
    clean, places = scene(3)
    noisy = clean + 0.02 * torch.randn(clean.shape, generator=seeded(4), dtype=torch.float64)
    found, indices = vca(noisy, 3, seeded())
    assert sorted(indices.tolist()) == places.tolist()
    truth = clean[indices]
    assert float((found - truth).norm()) < 0.6 * float((noisy[indices] - truth).norm())


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (5, "span only 3 dimensions: 5 endmembers were asked for"),
        (1, "between 2 and 24 .* 1 were asked for"),
        (25, "between 2 and 24 .* 25 were asked for"),
    ],
)
def test_more_endmembers_than_pixels_span_or_bands_or_fewer_than_two_are_refused(count, said):
    with pytest.raises(SpectrumError, match=said):
        vca(mixed_pixels(smooth_endmembers(3), 200, seed=0), count, seeded())


def volume_in_plane(points):
    """Volume from the Gram determinant of the edges: needs no reduced coordinates."""
    edges = points[1:] - points[0]
    factorial = torch.arange(1, len(edges) + 1, dtype=torch.float64).prod()
    return torch.linalg.det(edges @ edges.T).clamp(min=0).sqrt() / factorial


@given(st.integers(2, 7), st.integers(0, 1000))
def test_pure_pixels_span_the_largest_simplex(num_endmembers, seed):
    pixels, places = scene(num_endmembers, mixtures_seed=seed)
    assert sorted(nfindr(pixels, num_endmembers, seeded(seed)).tolist()) == places.tolist()


@given(st.integers(0, 200))
def test_on_a_plane_no_single_swap_enlarges_the_simplex(seed):
    points = torch.randn(30, 2, dtype=torch.float64, generator=seeded(seed))
    pixels = torch.cat([points, torch.ones(30, 1, dtype=torch.float64)], dim=1) + 5
    chosen = nfindr(pixels, 3, seeded(seed)).tolist()
    largest = volume_in_plane(pixels[chosen])
    assert len(set(chosen)) == 3
    for corner in range(3):
        for other in range(30):
            swapped = [*chosen[:corner], other, *chosen[corner + 1 :]]
            assert volume_in_plane(pixels[swapped]) <= largest * (1 + 1e-6)


def test_pixels_on_one_ray_are_told_from_pixels_on_a_plane():
    # Three dimensions through the origin but corners on one line: VCA is content, the simplex is not.
    base = torch.tensor([0.5, 0.5, 0.5], dtype=torch.float64)
    step = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64)
    pixels = base + torch.linspace(0, 1, 20, dtype=torch.float64)[:, None] * step
    assert sorted(nfindr(pixels, 2, seeded()).tolist()) == [0, 19]
    with pytest.raises(SpectrumError, match="at most 2"):
        nfindr(pixels, 3, seeded())


@settings(max_examples=15)
@given(st.integers(3, 5), st.integers(0, 100))
def test_materials_of_which_no_pixel_is_pure_are_found(num_endmembers, seed):
    materials = smooth_endmembers(num_endmembers)
    pixels = mixed_pixels(materials, 2000, seed=seed, max_abundance=0.85)
    found = minimum_volume_simplex(pixels, num_endmembers, seeded(seed))
    assert worst_angle(found, materials) < 0.12
    assert float(found.min()) >= 0
    assert_close(found.sum(1), torch.ones(num_endmembers, dtype=torch.float64))


def test_the_minimum_volume_reaches_further_than_the_purest_pixels_under_any_shading():
    materials = smooth_endmembers(4)
    pixels = mixed_pixels(materials, 2000, seed=1, max_abundance=0.8)
    purest = worst_angle(pixels[nfindr(pixels / pixels.sum(1, keepdim=True), 4, seeded())], materials)
    found = minimum_volume_simplex(pixels, 4, seeded())
    assert worst_angle(found, materials) < 0.4 * purest
    gains = 0.1 + torch.rand(2000, 1, dtype=torch.float64, generator=seeded())
    assert_close(minimum_volume_simplex(gains * pixels, 4, seeded()), found, atol=1e-4, rtol=0)
    pixels[[4, 9]] = 0
    with pytest.raises(SpectrumError, match="positive sum; found 2 others"):
        minimum_volume_simplex(pixels, 3, seeded())


def test_a_few_outliers_may_stay_outside():
    materials = smooth_endmembers(3)
    pixels = mixed_pixels(materials, 3000, seed=3, max_abundance=0.95)
    stray = torch.rand(9, pixels.shape[1], dtype=torch.float64, generator=seeded(4)) + 0.02
    found = minimum_volume_simplex(torch.cat([pixels, stray]), 3, seeded())
    assert worst_angle(found, materials) < 0.12


@pytest.mark.parametrize("find", [nfindr, minimum_volume_simplex])
def test_a_flat_simplex_is_refused(find):
    # Rays through two corners of a plane: three independent spectra do not exist in the affine sense.
    first, second = smooth_endmembers(2)
    weights = torch.rand(50, 1, dtype=torch.float64, generator=seeded())
    with pytest.raises(SpectrumError, match="3 endmembers were asked for; ask for at most 2"):
        find(weights * first + (1 - weights) * second, 3, seeded())
