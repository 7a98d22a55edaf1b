import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.spectral.mixtures import mixed_pixels, seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.endmembers import minimum_volume_simplex
from unmix_plugin.spectral.unmixing.nfindr_winter1999 import nfindr


def worst_angle(found, materials):
    """Largest angle of a material to the nearest found spectrum."""
    return float(spectral_angle(materials[:, None], found[None]).amin(1).max())


@settings(max_examples=15)
@given(st.integers(3, 5), st.integers(0, 100))
def test_materials_of_which_no_pixel_is_pure_are_found(num_endmembers, seed):
    materials = smooth_endmembers(num_endmembers)
    pixels = mixed_pixels(materials, 2000, seed=seed, max_abundance=0.85)
    found = minimum_volume_simplex(pixels, num_endmembers, seeded(seed))
    assert worst_angle(found, materials) < 0.12


def test_it_reaches_further_than_the_purest_pixels():
    materials = smooth_endmembers(4)
    pixels = mixed_pixels(materials, 2000, seed=1, max_abundance=0.8)
    purest = pixels[nfindr(pixels / pixels.sum(1, keepdim=True), 4, seeded())]
    assert worst_angle(minimum_volume_simplex(pixels, 4, seeded()), materials) < 0.4 * worst_angle(
        purest, materials
    )


def test_shading_changes_nothing():
    pixels = mixed_pixels(smooth_endmembers(4), 1000, seed=2)
    gains = 0.1 + torch.rand(1000, 1, dtype=torch.float64, generator=seeded())
    plain, shaded = (minimum_volume_simplex(p, 4, seeded()) for p in (pixels, gains * pixels))
    assert_close(plain, shaded, atol=1e-4, rtol=0)


def test_a_few_outliers_may_stay_outside():
    materials = smooth_endmembers(3)
    pixels = mixed_pixels(materials, 3000, seed=3, max_abundance=0.95)
    stray = torch.rand(9, pixels.shape[1], dtype=torch.float64, generator=seeded(4)) + 0.02
    found = minimum_volume_simplex(torch.cat([pixels, stray]), 3, seeded())
    assert worst_angle(found, materials) < 0.12


def test_a_higher_price_of_outliers_gives_a_larger_simplex():
    pixels = mixed_pixels(smooth_endmembers(3), 2000, seed=5)
    pixels = pixels * (1 + 0.05 * torch.randn(pixels.shape, dtype=torch.float64, generator=seeded()))
    spreads = []
    for penalty in (5.0, 50.0, 500.0):
        corners = minimum_volume_simplex(pixels, 3, seeded(), outlier_penalty=penalty)
        spreads.append(float(spectral_angle(corners[[0, 0, 1]], corners[[1, 2, 2]]).sum()))
    assert spreads[0] < spreads[1] < spreads[2]


def test_corners_are_spectra_of_sum_one_in_the_type_of_the_pixels():
    pixels = mixed_pixels(smooth_endmembers(3), 500, seed=6).float()
    found = minimum_volume_simplex(pixels, 3, seeded())
    assert found.dtype == torch.float32
    assert float(found.min()) >= 0
    assert_close(found.sum(1), torch.ones(3))


def test_the_same_generator_gives_the_same_corners():
    pixels = mixed_pixels(smooth_endmembers(4), 800, seed=7)
    assert torch.equal(
        minimum_volume_simplex(pixels, 4, seeded(3)), minimum_volume_simplex(pixels, 4, seeded(3))
    )


def test_pixels_without_light_are_refused():
    pixels = mixed_pixels(smooth_endmembers(3), 50, seed=8)
    pixels[[4, 9]] = 0
    with pytest.raises(SpectrumError, match="positive sum; found 2 others"):
        minimum_volume_simplex(pixels, 3, seeded())


def test_a_flat_simplex_is_refused():
    first, second = smooth_endmembers(2)
    weights = torch.rand(50, 1, dtype=torch.float64, generator=seeded())
    with pytest.raises(SpectrumError, match="3 endmembers were asked for; ask for at most 2"):
        minimum_volume_simplex(weights * first + (1 - weights) * second, 3, seeded())
