import torch
from torch.testing import assert_close

from tests.spectral.mixtures import seeded, smooth_endmembers
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels
from unmix_plugin.spectral.unmixing.mixture_guide import MixtureGuide
from unmix_plugin.spectral.unmixing.sparse_unmixing import sparse_abundances
from unmix_plugin.spectral.unmixing.two_material_mixtures import mean_pair_distance


def started(noise=0.0):
    endmembers = smooth_endmembers(4).float() * 0.8
    shares = torch.eye(4).repeat(30, 1)
    pixels = shares @ endmembers + noise * torch.rand(120, endmembers.shape[1], generator=seeded(0))
    guide = MixtureGuide(4, endmembers.shape[1])
    guide.start(pixels, endmembers, 2.0)
    return guide, endmembers


def test_abundances_that_the_measured_spectra_show_are_no_error():
    guide, endmembers = started()
    measured = 0.5 * endmembers
    assert float(guide.error(torch.eye(4), measured, torch.ones(4))) < 1e-6
    wrong = torch.eye(4).roll(1, dims=1)
    assert_close(guide.error(wrong, measured, torch.ones(4)), torch.tensor(2.0), atol=1e-2, rtol=0)


def test_a_half_transparent_pixel_shows_half_of_its_mixture():
    guide, endmembers = started()
    alpha = torch.full((4,), 0.5)
    assert float(guide.error(0.5 * torch.eye(4), 0.5 * endmembers, alpha)) < 1e-6
    assert float(guide.error(torch.eye(4), 0.5 * endmembers, alpha)) > 0.1


def test_black_and_saturated_pixels_say_nothing():
    guide, endmembers = started()
    silent = torch.stack([torch.zeros_like(endmembers[0]), torch.ones_like(endmembers[0])])
    assert float(guide.error(torch.rand(2, 4, generator=seeded(2)), silent, torch.ones(2))) == 0


def test_what_pairs_leave_unexplained_sets_the_penalty_of_further_materials():
    assert float(started()[0].mixing_penalty) < 1e-3
    assert float(started(noise=0.2)[0].mixing_penalty) > float(started(noise=0.05)[0].mixing_penalty) > 1e-3


def test_the_penalty_grows_with_the_square_of_what_is_unexplained_and_then_in_proportion():
    endmembers = smooth_endmembers(4).float() * 0.8
    off = torch.rand(120, endmembers.shape[1], generator=seeded(0))
    seen = []
    for noise in (0.01, 0.02, 0.4):
        pixels = torch.eye(4).repeat(30, 1) @ endmembers + noise * off
        angle = mean_pair_distance(drop_uninformative_pixels(pixels), endmembers)
        seen.append(angle)
        guide = MixtureGuide(4, endmembers.shape[1])
        guide.start(pixels, endmembers, 2.0)
        expected = 100 * angle**2 if angle < 0.03 else 3 * angle
        assert_close(float(guide.mixing_penalty), expected, rtol=1e-4, atol=0)
    assert seen[0] < seen[1] < 0.03 < seen[2]


def test_a_saved_guide_guides_as_before():
    guide, endmembers = started(noise=0.05)
    other = MixtureGuide(4, endmembers.shape[1])
    other.load_state_dict(guide.state_dict())
    measured = torch.rand(50, 4, generator=seeded(5)) @ endmembers * 0.3
    abundances = torch.full((50, 4), 0.25)
    assert_close(
        other.error(abundances, measured, torch.ones(50)), guide.error(abundances, measured, torch.ones(50))
    )
    unmixed = sparse_abundances(measured, endmembers, float(guide.mixing_penalty))
    assert_close(other.error(unmixed, measured, torch.ones(50)), torch.tensor(0.0), atol=1e-9, rtol=0)


def observed(guide, endmembers, deviation, steps=60, seed=6):
    """The guide after steps in which leads are off by a normal error: shares of two materials, one too large."""
    for step in range(steps):
        generator = seeded(seed + step)
        share = 0.5 + 0.4 * torch.rand(200, 1, generator=generator)
        pure = torch.eye(4)[torch.randint(4, (200,), generator=generator)]
        mixed = share * pure + (1 - share) * pure.roll(1, dims=1)
        error = deviation / 2 * torch.randn(200, 1, generator=generator)
        guide.error(mixed + error * (pure - pure.roll(1, dims=1)), 0.5 * mixed @ endmembers, torch.ones(200))
    return guide


def test_the_error_of_leads_is_what_field_and_pixels_differ_by_widened_for_what_both_get_wrong():
    guide, endmembers = started()
    assert guide.lead_error.isinf()
    one_material = endmembers / endmembers.norm(dim=1, keepdim=True)  # then shares are those of light
    guide.endmembers.copy_(one_material)
    small = float(observed(guide, one_material, 0.02).lead_error)
    assert abs(small - 2**0.5 * 0.02) < 0.005
    assert float(observed(guide, one_material, 0.2, steps=300).lead_error) > 3 * small


def test_rendering_a_view_does_not_change_what_is_known_of_errors():
    guide, endmembers = started()
    known = float(observed(guide, endmembers, 0.05, steps=3).lead_error)
    assert float(observed(guide.eval(), endmembers, 0.5, steps=3).lead_error) == known


def test_pixels_that_say_nothing_leave_the_error_of_leads_unknown():
    guide, endmembers = started()
    guide.error(torch.full((4, 4), 0.25), torch.zeros_like(endmembers), torch.ones(4))
    assert guide.lead_error.isinf()
