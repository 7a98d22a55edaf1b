import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.factories.mixtures import mixed_pixels, seeded, smooth_endmembers, surface_pixels
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.subspace import estimate_noise
from unmix_plugin.spectral.unmixing.num_materials import elbow, hysime, propose_num_materials


def gaussian(shape, deviation, seed=0):
    return deviation * torch.randn(shape, dtype=torch.float64, generator=seeded(seed))


@settings(max_examples=12)
@given(st.integers(1, 7), st.integers(0, 50))
def test_the_number_of_materials_on_surfaces_is_proposed(num_materials, seed):
    pixels = surface_pixels(smooth_endmembers(num_materials), seed, noise=0.001)
    assert propose_num_materials(pixels, seeded(seed)).number == num_materials


def test_noise_is_not_taken_for_materials_nor_does_it_hide_them():
    pixels = surface_pixels(smooth_endmembers(5), per_material=300, per_pair=60)
    pixels = pixels[pixels.norm(dim=1) > 0.5]
    noisy = (pixels + gaussian(pixels.shape, 0.02)).clamp(min=1e-4)
    count = propose_num_materials(noisy, seeded())
    assert count.number == 5
    relative = gaussian(pixels.shape, 0.02).norm(dim=1) / pixels.norm(dim=1)
    assert count.noise_distance == pytest.approx(float(relative.mean()), rel=0.15)


def test_a_gloss_on_some_pixels_counts_as_one_material_at_most():
    pixels = surface_pixels(smooth_endmembers(4))
    glossy = pixels.clone()
    glossy[::5] += 0.1
    assert propose_num_materials(glossy, seeded()).number - 4 in (0, 1)


def test_the_proposal_comes_with_its_evidence():
    count = propose_num_materials(surface_pixels(smooth_endmembers(3), noise=0.001), seeded())
    assert list(count.mean_distances) == sorted(count.mean_distances, reverse=True)
    lines = count.evidence().splitlines()
    assert [line.endswith("<- proposed") for line in lines[1:13]] == [number == 3 for number in range(1, 13)]
    assert f"HySime: {count.signal_dimensions} dimensions" in lines[-1]
    few = propose_num_materials(smooth_endmembers(3).repeat(5, 1), seeded())  # of many bands: without HySime
    assert (few.number, few.signal_dimensions) == (3, None)
    assert "HySime" not in few.evidence()


def test_the_elbow_is_where_a_further_material_helps_little():
    elbows = {
        (0.003,): 1,
        (0.0, 0.0): 1,
        (0.2, 0.19, 0.01): 1,
        (0.2, 0.1, 0.09, 0.01): 2,
        (0.2, 0.1, 0.05, 0.046): 3,
        (0.2, 0.1, 0.006, 0.0021): 3,
        (0.2, 0.1, 0.05, 0.02): 4,
    }
    assert {distances: elbow(distances) for distances in elbows} == elbows


@settings(max_examples=15)
@given(st.integers(2, 8), st.integers(0, 100))
def test_hysime_counts_the_endmembers_of_linear_mixtures_in_noise(num_endmembers, seed):
    pixels = mixed_pixels(smooth_endmembers(num_endmembers), 3000, seed=seed, max_abundance=1.0)
    assert hysime(pixels + gaussian(pixels.shape, 1e-3, seed)) == num_endmembers


def test_hysime_finds_nothing_in_noise_alone_and_everything_without_noise_in_enough_pixels():
    assert hysime(gaussian((3000, 12), 1.0)) == 0
    assert hysime(mixed_pixels(smooth_endmembers(4), 500, seed=1)) == 4
    for bands, said in ((24, "found 24 pixels of 24 bands"), (1, "at least two bands")):
        with pytest.raises(SpectrumError, match=said):
            hysime(torch.rand(24, bands))


def test_noise_of_each_band_is_told_from_what_other_bands_predict():
    pixels = mixed_pixels(smooth_endmembers(4, num_bands=30), 5000, seed=2)
    deviations = torch.linspace(3e-3, 1e-2, 30, dtype=torch.float64)
    noise = gaussian(pixels.shape, 1.0) * deviations
    found = estimate_noise(pixels + noise)
    np.testing.assert_allclose(found.std(dim=0), deviations, rtol=0.2)
    assert float((found * noise).sum() / (found.norm() * noise.norm())) > 0.9
