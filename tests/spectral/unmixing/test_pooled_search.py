import pytest
import torch
from torch.testing import assert_close

from tests.factories.mixtures import mixed_pixels, seeded, smooth_endmembers, surface_pixels, worst_angle
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.pooled_search import pooled_search


def dark_water(seed=0):
    """Two bright materials that meet, and a dark one whose shape varies more than they differ: as water under haze."""
    generator = seeded(seed)
    bright = smooth_endmembers(3)[:2]
    water = torch.linspace(0.08, 0.004, 24, dtype=torch.float64) ** 1.5 * 2
    haze = torch.rand(700, 1, dtype=torch.float64, generator=generator) * 0.012
    share = torch.rand(700, 1, dtype=torch.float64, generator=generator).round(decimals=1)
    land = share * bright[0] + (1 - share) * bright[1]
    pixels = torch.cat([land, water + haze])
    pixels = pixels + 0.0007 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    return pixels.clamp(min=0).float(), torch.stack([*bright, water + 0.006])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_dark_material_whose_shape_varies_costs_no_bright_one(seed):
    pixels, materials = dark_water(seed)
    found = pooled_search(pixels, 3, seeded(seed)).endmembers
    assert worst_angle(found, materials) < 0.12


def gradual_pixels(materials):
    """Smooth mixtures of four materials."""
    shares = torch.rand(1500, 4, dtype=torch.float64, generator=seeded()) ** 8
    return (shares / shares.sum(dim=1, keepdim=True)) @ materials


@pytest.mark.parametrize("made_of", [surface_pixels, pytest.param(gradual_pixels, marks=pytest.mark.slow)])
def test_materials_are_found_among_edges_and_among_smooth_mixtures_whatever_the_seed(made_of):
    materials = smooth_endmembers(4)
    pixels = made_of(materials).float()
    first, second = (pooled_search(pixels, 4, seeded(seed)).endmembers for seed in (1, 2))
    assert worst_angle(first, materials) < 0.06
    assert worst_angle(first, second) < 0.02


@pytest.mark.usefixtures("few_searches")
def test_spectra_have_length_one_and_the_best_sets_the_same_order():
    pixels = mixed_pixels(smooth_endmembers(3), 800, seed=0).float()
    found = pooled_search(pixels, 3, seeded())
    assert found.endmembers.dtype == torch.float32
    assert float(found.endmembers.min()) >= 0
    assert_close(found.endmembers.norm(dim=1), torch.ones(3))
    assert found.others.shape == (5, 3, pixels.shape[1])
    assert float(spectral_angle(found.others, found.endmembers).mean(dim=1).min()) < 0.06
    again = pooled_search(pixels, 3, seeded())
    assert torch.equal(found.endmembers, again.endmembers)


def test_few_shapes_are_searched_in_pairs_and_too_many_endmembers_refused():
    pixels = smooth_endmembers(3).repeat(30, 1).float()
    assert worst_angle(pooled_search(pixels, 3, seeded()).endmembers, smooth_endmembers(3)) < 1e-3
    with pytest.raises(SpectrumError, match="ask for at most 3"):
        pooled_search(pixels, 4, seeded())
