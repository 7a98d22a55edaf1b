"""How spectra are compared and shown."""

import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.tone.spectral import LampRatio, SpectralDisplay
from unmix_plugin.spectral.bands import Bands

LAMP = (0.2, 0.6, 1.0)


def test_light_counts_by_the_lamps_power_and_by_its_logarithm_above_it():
    curve = LampRatio(LAMP)
    assert_close(curve(torch.tensor([0.1, 0.3, 0.5])), torch.full((3,), 0.5))
    assert_close(curve(torch.e * torch.tensor(LAMP)), torch.full((3,), 2.0))


def test_the_curve_and_its_slope_have_no_step():
    curve = LampRatio((1.0,))
    ratio = torch.tensor([0.0, 0.5, 1 - 1e-3, 1 + 1e-3, 4.0]).requires_grad_()
    values = curve(ratio[:, None])[:, 0]
    (slope,) = torch.autograd.grad(values.sum(), ratio)
    assert_close(values, torch.tensor([0.0, 0.5, 0.999, 1.001, 2.3863]), atol=1e-4, rtol=0)
    assert_close(slope, torch.tensor([1.0, 1.0, 1.0, 0.999, 0.25]), atol=1e-4, rtol=0)


def test_relative_errors_of_bright_pixels_count_alike_and_dark_ones_have_no_boundless_weight():
    light = torch.tensor([0.0, 1e-4, 1.0, 40.0, 80.0])[:, None] * torch.tensor(LAMP)
    weights = LampRatio(LAMP).weights(light)[:, 0]
    assert_close(weights[3] / weights[4], torch.tensor(2.0), rtol=0.1, atol=0)
    assert_close(weights[0], weights[1], rtol=1e-3, atol=0)
    assert_close(weights.square().mean(), torch.tensor(1.0))


def test_the_weights_of_pixels_do_not_depend_on_the_exposure_nor_on_the_lamp():
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    weights = LampRatio((1.0, 1.0, 1.0)).weights(light)
    assert_close(LampRatio(LAMP).weights(7 * light * torch.tensor(LAMP)), weights)


def test_a_flat_spectrum_is_shown_as_a_grey():
    display = SpectralDisplay(Bands.of([450, 500, 550, 600, 650]))
    assert_close(display.rgb(torch.full((5,), 0.4)), torch.full((3,), 0.4))
    shown = display(torch.full((5,), 0.4))
    assert float(shown.max() - shown.min()) < 1e-3
