"""The brightness of endmembers: how it is first found, and how gains change it."""

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.endmember_gains import settle
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.neumatex.spectral_start import as_bright

unit = torch.nn.functional.normalize
DARK_AND_BRIGHT = torch.tensor([[0.05, 0.1, 0.2, 0.1], [0.9, 0.8, 0.4, 0.2]])


def test_mixed_pixels_do_not_make_dark_endmembers_brighter_nor_bright_ones_darker():
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(5000, 1, generator=generator)
    share[:200], share[200:400] = 0.0, 1.0  # few show one material alone
    pixels = torch.cat([share, 1 - share], dim=1) @ DARK_AND_BRIGHT
    purity = unit(pixels, dim=1) @ unit(DARK_AND_BRIGHT, dim=1).T
    assert_close(as_bright(unit(DARK_AND_BRIGHT, dim=1), pixels, purity), DARK_AND_BRIGHT, rtol=1e-3, atol=0)


def test_no_band_of_a_first_endmember_is_above_1_and_its_shape_stays():
    found = as_bright(DARK_AND_BRIGHT, 5 * DARK_AND_BRIGHT, torch.eye(2))
    assert float(found.max()) <= 1
    assert_close(unit(found, dim=1), unit(DARK_AND_BRIGHT, dim=1))


@pytest.mark.parametrize("gains", [(0.5, 1.05), (3.0, 2.0)])
def test_gains_leave_spectral_angles_as_they_are_and_reflectances_at_most_1(gains):
    endmembers, factors = DARK_AND_BRIGHT.clone(), torch.tensor(gains)
    settle(endmembers, factors)
    assert_close(unit(endmembers, dim=1), unit(DARK_AND_BRIGHT, dim=1))
    assert float(endmembers.max()) <= 1
    assert factors.tolist() == [1.0, 1.0]


def test_a_material_reflects_the_same_before_and_after_its_gains_are_settled():
    endmembers, gains = DARK_AND_BRIGHT.clone(), torch.tensor([1.5, 0.7])
    family = SpectralFamily(endmembers, gains)
    parameters = torch.tensor([[0.4, 0.6, 0.5, 0.2]])
    before = family.base_colour(parameters)
    assert_close(before, torch.tensor([[0.6, 0.42]]) @ DARK_AND_BRIGHT)
    settle(endmembers, gains)
    assert_close(family.base_colour(parameters), before)


def test_the_gradient_of_a_gain_is_that_of_all_bands_of_its_endmember_together():
    endmembers, gains = DARK_AND_BRIGHT.clone().requires_grad_(), torch.ones(2, requires_grad=True)
    light = SpectralFamily(endmembers, gains).base_colour(torch.tensor([[0.4, 0.6, 0.5, 0.2]])).square().sum()
    of_endmembers, of_gains = torch.autograd.grad(light, (endmembers, gains))
    assert_close(of_gains, (of_endmembers * endmembers).sum(dim=1))
