"""What views show of points: fits that must find what colours were made of."""

import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.prior.light_lobes import NUM_LOBES
from unmix_plugin.neumatex.prior.observations import compressed, lobe_fits


def made_of(lobe: int):
    """Colours of 30 points in 12 views: an albedo times the light that reaches them, and a share of one lobe."""
    g = torch.Generator().manual_seed(0)
    mirrored = 2 * torch.rand(30, 12, NUM_LOBES, 3, generator=g)
    reaching, albedo = 0.5 + torch.rand(30, 3, generator=g), torch.rand(30, 3, generator=g)
    share = 0.2 + 0.5 * torch.rand(30, 3, generator=g)
    colours = (albedo * (reaching + 0.02))[:, None] + share[:, None] * mirrored[:, :, lobe]
    return colours, mirrored, reaching, albedo, share


def test_a_fit_finds_albedo_and_share_and_leaves_nothing_only_for_the_right_lobe():
    colours, mirrored, reaching, albedo, share = made_of(lobe=2)
    fits = lobe_fits(colours, mirrored, torch.ones(30, 12), reaching).unflatten(-1, (NUM_LOBES, 7))
    found_share, found_albedo, left = fits[:, 2].split((3, 3, 1), dim=-1)
    # The ridge of the fit makes shares a little small, most where the light happens to vary little.
    assert_close(found_share, share, atol=0.15, rtol=0)
    assert_close(found_albedo, albedo, atol=0.2, rtol=0)
    assert left.max() < 0.05
    assert fits[:, [0, 1, 3], 6].mean() > 0.5


def test_views_without_weight_change_nothing():
    colours, mirrored, reaching, _, _ = made_of(lobe=0)
    weights = torch.ones(30, 12)
    weights[:, 8:] = 0
    spoiled = colours.clone()
    spoiled[:, 8:] = 7.0
    expected = lobe_fits(colours[:, :8], mirrored[:, :8], weights[:, :8], reaching)
    assert_close(lobe_fits(spoiled, mirrored, weights, reaching), expected)


def test_a_point_that_nothing_sees_has_finite_numbers():
    colours, mirrored, reaching, _, _ = made_of(lobe=0)
    assert torch.isfinite(lobe_fits(colours, mirrored, torch.zeros(30, 12), reaching)).all()


def test_light_is_compressed_between_0_and_1_in_order():
    light = torch.tensor([0.0, 0.1, 1.0, 8.0, 100.0])
    values = compressed(light)
    assert values[0] == 0
    assert_close(values[3], torch.tensor(1.0))
    assert (values[1:4] > values[:3]).all()
    assert values[4] == values[3]
