import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.spectral import evidence


def test_noise_of_the_background_is_told_from_the_faintest_matter():
    noise = (1e-3 * torch.randn(2000, 6, generator=torch.Generator().manual_seed(0))).abs()
    spectra = torch.cat([noise, torch.full((500, 6), 0.1)])
    alpha = torch.cat([torch.zeros(2000), torch.ones(500)])
    level = evidence.background_level(spectra, alpha)
    assert level is not None
    assert float((evidence.brightness(spectra[:2000]) > level).double().mean()) < 0.002
    assert level < 0.005


def test_a_background_as_bright_as_matter_says_nothing():
    spectra = torch.cat([torch.full((50, 6), 0.8), torch.full((50, 6), 0.3)])
    alpha = torch.cat([torch.zeros(50), torch.ones(50)])
    assert evidence.background_level(spectra, alpha) is None
    assert_close(evidence.alpha_confidence(spectra, alpha, None), torch.ones(100))


@pytest.mark.parametrize(
    ("value", "alpha", "trust", "shows"),
    [
        (0.3, 1.0, 1, True),  # matter
        (0.0, 0.0, 1, False),  # nothing
        (0.15, 0.5, 1, True),  # an edge
        (0.3, 0.0, 0, True),  # a hole in the mask
        (0.3, 0.1, 0, True),  # a mask that is too small
        (0.001, 1.0, 0, False),  # a speck, or a mask that is too large
    ],
)
def test_alpha_is_believed_unless_light_contradicts_it(value, alpha, trust, shows):
    spectra, alphas = torch.full((1, 6), value), torch.tensor([alpha])
    assert float(evidence.alpha_confidence(spectra, alphas, 0.002)) == trust
    assert bool(evidence.may_show_foreground(spectra, alphas, 0.002)) == shows


def test_only_dark_scenes_are_exposed_and_one_saturated_band_blows_a_pixel_out():
    assert evidence.exposure_of(torch.full((10, 3), 0.4)) == 1.0
    assert evidence.exposure_of(torch.full((10, 3), 0.02)) == pytest.approx(10.0)
    assert evidence.exposure_of(torch.zeros(10, 3)) == 100.0
    assert evidence.is_blown_out(torch.tensor([[0.2, 0.95, 0.3], [0.2, 0.85, 0.3]])).tolist() == [True, False]


def test_large_errors_grow_in_proportion_with_a_continuous_slope():
    errors = torch.tensor([[-0.5, 1.0], [2.0, 3.0]], requires_grad=True)
    found = evidence.bounded_square(errors, torch.ones(2, 1))
    assert_close(found.detach(), torch.tensor([[0.25, 1.0], [3.0, 5.0]]))
    (slopes,) = torch.autograd.grad(found.sum(), errors)
    assert_close(slopes, torch.tensor([[-1.0, 2.0], [2.0, 2.0]]))


def pixels_of_contrast(contrast: float) -> torch.Tensor:
    """Pixels of which the brighter fifth is so much brighter than the others."""
    pixels = torch.full((100, 3), 0.1)
    pixels[:20] *= contrast
    return pixels


@pytest.mark.parametrize("factor", [0.01, 1.0, 5.0])
def test_errors_count_absolutely_unless_some_of_the_scene_is_much_brighter_than_the_rest(factor):
    """However bright the scene is."""
    contrasts = (1.0, 2.5, 3.0, 4.0, 8.0)
    powers = [evidence.relative_power_of(factor * pixels_of_contrast(contrast)) for contrast in contrasts]
    assert powers[:2] == [0.0, 0.0]
    assert 0 < powers[2] < powers[3] < 1.5
    assert powers[4] == 1.5
    plain = [evidence.relative_power_of(pixels_of_contrast(contrast)) for contrast in contrasts]
    assert powers == pytest.approx(plain)
    highlights = torch.full((100, 3), 0.1)
    highlights[:5] = 1.0
    for pixels in (highlights, torch.zeros(0, 3), torch.zeros(10, 3)):
        assert evidence.relative_power_of(pixels) == 0.0
