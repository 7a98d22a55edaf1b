import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.factories.mixtures import mixed_pixels, seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.metrics import spectral_angle
from unmix_plugin.spectral.unmixing import endmembers
from unmix_plugin.spectral.unmixing.endmembers import (
    comparable_brightness,
    distinct_spectra,
    drop_uninformative_pixels,
    fill_bands,
    initialise_endmembers,
    typical_spectrum,
)

METHODS = ["kmeans", "vca", "nfindr", "minimum-volume", "pairs", "pooled"]


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


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25)
@given(num_endmembers=st.integers(1, 6), seed=st.integers(0, 50))
def test_every_method_finds_materials_of_which_most_pixels_are_pure(method, num_endmembers, seed):
    pixels, materials = shaded_scene(num_endmembers, num_mixtures=5, seed=seed)
    found = initialise_endmembers(pixels, num_endmembers, method, seeded(seed))
    assert float(angles_to_materials(found, materials).max()) < 0.03
    if method in ("vca", "nfindr") and num_endmembers > 1:  # which take extreme pixels
        pixels, materials = shaded_scene(num_endmembers, seed=seed)
        found = initialise_endmembers(pixels, num_endmembers, method, seeded(seed))
        assert float(angles_to_materials(found, materials).max()) < 1e-3


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


@pytest.mark.usefixtures("few_searches")
@pytest.mark.parametrize("method", METHODS)
def test_dark_and_saturated_pixels_have_no_say(method):
    pixels, _ = shaded_scene(3)
    noise = 0.002 * torch.rand(4000, pixels.shape[1], generator=seeded(8))
    lamp = torch.rand(5, pixels.shape[1], generator=seeded(8))
    lamp[:, 3] = 1.0
    clean = initialise_endmembers(pixels, 3, method, seeded())
    for odd in (noise, lamp):
        assert torch.equal(initialise_endmembers(torch.cat([pixels, odd]), 3, method, seeded()), clean)


def test_pixels_are_dropped_by_brightness_and_saturation_alone():
    pixels = torch.tensor([[0.5, 0.5], [0.004, 0.004], [0.012, 0.012], [0.02, 0.02], [0.3, 1.0], [0.0, 0.0]])
    assert torch.equal(drop_uninformative_pixels(pixels), pixels[[0, 3]])


SOUND = shaded_scene(3)[0]
SPOILT = torch.cat([torch.full((1, 24), float("nan")), torch.full((1, 24), float("inf")), SOUND])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("pixels", "count", "said"),
    [
        (SOUND, 25, "between 1 and the number of bands, 24; found 25"),
        (SOUND, 0, "found 0"),
        (smooth_endmembers(3).repeat(100, 1), 4, r"4 .* only 3 distinct pixels .* \(of 300\); .* at most 3"),
        (torch.zeros(10, 4), 2, "only 0 distinct pixels .* check the scale"),
        (torch.zeros(0, 4), 2, r"only 0 distinct pixels .* \(of 0\)"),
        (SPOILT, 3, rf"2 of {len(SPOILT)} pixels hold NaN"),
    ],
)
def test_what_no_endmembers_can_be_found_in_is_refused(method, pixels, count, said):
    with pytest.raises(SpectrumError, match=said):
        initialise_endmembers(pixels, count, method, seeded())


@pytest.mark.usefixtures("few_searches")
@pytest.mark.parametrize("method", METHODS)
def test_many_pixels_are_thinned_by_the_generator(method, monkeypatch):
    pixels, _ = shaded_scene(3)
    every = initialise_endmembers(pixels, 3, method, seeded(4))
    monkeypatch.setattr(endmembers, "_MOST_PIXELS", 50)
    first, again = (initialise_endmembers(pixels, 3, method, seeded(4)) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, every)


TYPICAL = torch.tensor([0.1, 0.2, 0.4, 0.3, 0.2, 0.1])


def test_what_sensors_see_of_spectra_stays_and_other_bands_follow_the_typical_spectrum():
    brightness = torch.tensor([[0.5], [2.0]])
    some = torch.eye(6)[[3, 1, 2]]
    filled = fill_bands((brightness * TYPICAL) @ some.T, some, TYPICAL)
    assert_close(filled, brightness * TYPICAL, rtol=2e-2, atol=1e-3)
    seen = torch.tensor([[0.4, 0.3, 0.2, 0.1]])  # of another shape
    filled = fill_bands(seen, torch.eye(6)[:4], TYPICAL)
    assert_close(filled[:, :4], seen, rtol=0.1, atol=0.02)
    ratios = filled / TYPICAL
    assert_close(ratios[:, 4:], ratios[:, 3:4].expand(-1, 2), rtol=1e-3, atol=1e-3)
    broad, seen = torch.eye(3).repeat_interleave(2, dim=1) / 2, torch.tensor([[0.2, 0.3, 0.4]])
    assert_close(fill_bands(seen, broad, TYPICAL) @ broad.T, seen, rtol=0.03, atol=5e-3)


def test_a_typical_spectrum_agrees_with_all_sensors():
    first, second = torch.eye(6)[:3], torch.eye(6)[2:]
    found = typical_spectrum([TYPICAL[:3], TYPICAL[2:]], [first, second])
    assert_close(found, TYPICAL, rtol=0.02, atol=2e-3)
    assert (typical_spectrum([torch.zeros(3)], [first]) > 0).all()


def test_distinct_spectra_are_independent_and_in_range():
    spectra = distinct_spectra(TYPICAL, 6)
    assert int(torch.linalg.matrix_rank(spectra, rtol=1e-3)) == 6
    assert (spectra > 0).all()
    assert (spectra < 1).all()
    assert_close(spectra.mean(dim=0) / TYPICAL, torch.ones(6), rtol=0.3, atol=0)


def test_brightness_stays_unless_one_endmember_is_nearly_black():
    materials = smooth_endmembers(3).float()
    moderate = materials * torch.tensor([[1.0], [0.5], [0.3]])
    assert torch.equal(comparable_brightness(moderate), moderate)
    dark = comparable_brightness(materials * torch.tensor([[1.0], [0.5], [0.1]]))
    assert_close(dark.amax(dim=1), materials[0].amax().expand(3))
