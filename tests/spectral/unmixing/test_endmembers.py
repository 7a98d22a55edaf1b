import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.spectral.mixtures import mixed_pixels, seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels, initialise_endmembers

METHODS = ["kmeans", "vca", "nfindr", "minimum-volume", "pairs", "pooled-pairs"]


def shaded_scene(num_endmembers, num_mixtures=200, seed=0):
    """A hundred pure pixels a material and some mixtures, all shaded between 0.2 and 1."""
    materials = smooth_endmembers(num_endmembers)
    pixels = torch.cat([materials.repeat(100, 1), mixed_pixels(materials, num_mixtures, seed=seed)])
    shading = 0.2 + 0.8 * torch.rand(len(pixels), 1, dtype=torch.float64, generator=seeded(seed))
    return (pixels * shading).float(), materials.float()


def angles_to_materials(found, materials):
    """Angle of each found spectrum to its material, after checking that each material was found once."""
    angles = spectral_angle(found[:, None], materials[None])
    assert found.shape == materials.shape
    assert sorted(angles.argmin(1).tolist()) == list(range(len(materials)))
    return angles.amin(1)


@pytest.mark.parametrize("method", ["vca", "nfindr"])
@given(num_endmembers=st.integers(2, 6), seed=st.integers(0, 50))
def test_extreme_pixels_have_the_shapes_of_the_materials_among_many_mixtures(method, num_endmembers, seed):
    pixels, materials = shaded_scene(num_endmembers, seed=seed)
    found = initialise_endmembers(pixels, num_endmembers, method, seeded(seed))
    assert float(angles_to_materials(found, materials).max()) < 1e-3


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25)
@given(num_endmembers=st.integers(1, 6), seed=st.integers(0, 50))
def test_every_method_finds_materials_of_which_most_pixels_are_pure(method, num_endmembers, seed):
    pixels, materials = shaded_scene(num_endmembers, num_mixtures=5, seed=seed)
    found = initialise_endmembers(pixels, num_endmembers, method, seeded(seed))
    assert float(angles_to_materials(found, materials).max()) < 0.03


@pytest.mark.parametrize("method", METHODS)
def test_endmembers_lie_in_the_unit_box_and_are_as_bright_as_lit_pixels(method):
    pixels, materials = shaded_scene(4)
    found = initialise_endmembers(pixels, 4, method, seeded())
    assert float(found.min()) >= 0
    assert float(found.max()) <= 1
    ids = spectral_angle(found[:, None], materials[None]).argmin(1)
    ratio = found.norm(dim=1) / materials[ids].norm(dim=1)
    assert float(ratio.min()) > 0.8
    assert float(ratio.max()) < 1.05


@pytest.mark.parametrize("method", METHODS)
def test_dark_pixels_have_no_say(method):
    pixels, _ = shaded_scene(3)
    noise = 0.002 * torch.rand(4000, pixels.shape[1], generator=seeded(8))
    clean = initialise_endmembers(pixels, 3, method, seeded())
    assert torch.equal(initialise_endmembers(torch.cat([pixels, noise]), 3, method, seeded()), clean)


@pytest.mark.parametrize("method", METHODS)
def test_saturated_pixels_have_no_say(method):
    pixels, _ = shaded_scene(3)
    lamp = torch.rand(5, pixels.shape[1], generator=seeded(8))
    lamp[:, 3] = 1.0
    clean = initialise_endmembers(pixels, 3, method, seeded())
    assert torch.equal(initialise_endmembers(torch.cat([pixels, lamp]), 3, method, seeded()), clean)


def test_pixels_are_dropped_by_brightness_and_saturation_alone():
    pixels = torch.tensor([[0.5, 0.5], [0.004, 0.004], [0.012, 0.012], [0.02, 0.02], [0.3, 1.0], [0.0, 0.0]])
    assert torch.equal(drop_uninformative_pixels(pixels), pixels[[0, 3]])


@pytest.mark.parametrize("method", METHODS)
def test_many_pixels_are_thinned_by_the_generator(method):
    pixels, _ = shaded_scene(3)
    first, again = (initialise_endmembers(pixels, 3, method, seeded(4), max_pixels=50) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, initialise_endmembers(pixels, 3, method, seeded(4)))


@pytest.mark.parametrize("method", METHODS)
def test_more_endmembers_than_bands_are_refused(method):
    pixels, _ = shaded_scene(3)
    with pytest.raises(SpectrumError, match="between 1 and the number of bands, 24; found 25"):
        initialise_endmembers(pixels, 25, method, seeded())
    with pytest.raises(SpectrumError, match="found 0"):
        initialise_endmembers(pixels, 0, method, seeded())


@pytest.mark.parametrize("method", METHODS)
def test_more_endmembers_than_distinct_pixels_are_refused(method):
    pixels = smooth_endmembers(3).repeat(100, 1)
    with pytest.raises(
        SpectrumError, match=r"4 endmembers .* only 3 distinct pixels .* \(of 300\); ask for at most 3"
    ):
        initialise_endmembers(pixels, 4, method, seeded())


def test_a_black_scene_is_refused_with_advice():
    with pytest.raises(SpectrumError, match=r"only 0 distinct pixels .* check the scale"):
        initialise_endmembers(torch.zeros(10, 4), 2, "kmeans", seeded())
    with pytest.raises(SpectrumError, match=r"only 0 distinct pixels .* \(of 0\)"):
        initialise_endmembers(torch.zeros(0, 4), 2, "vca", seeded())


def test_pixels_that_are_not_finite_are_refused_with_their_number():
    pixels, _ = shaded_scene(3)
    pixels[[3, 9], 0] = torch.tensor([float("nan"), float("inf")])
    with pytest.raises(SpectrumError, match=rf"2 of {len(pixels)} pixels hold NaN"):
        initialise_endmembers(pixels, 3, "vca", seeded())


def test_below_a_root_mean_square_of_0005_even_the_brightest_pixels_are_dark():
    pixels = torch.tensor([[0.0049, 0.0049], [0.0051, 0.0051]])
    assert torch.equal(drop_uninformative_pixels(pixels), pixels[1:])
