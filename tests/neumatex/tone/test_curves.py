"""Fixed tone curves: their fixed points, and their slopes."""

import pytest
import torch

from unmix_plugin.neumatex.tone.curves import psnr_db, tone_curve


@pytest.mark.parametrize("name", ["srgb", "agx"])
def test_curves_increase_for_greys_and_stay_in_0_to_1(name):
    light = torch.logspace(-3, 1.2, 200)[:, None].expand(-1, 3)
    numbers = tone_curve(name)(light)
    assert (numbers.diff(dim=0) >= -1e-4).all()
    assert numbers.min() >= 0
    assert numbers.max() <= 1
    assert numbers[-1].min() > 0.98


@pytest.mark.parametrize("name", ["linear", "srgb", "agx"])
def test_slopes_are_those_of_differences(name):
    light = torch.tensor([[0.05, 0.18, 0.6], [0.3, 0.9, 0.02]], dtype=torch.float64)
    curve = tone_curve(name)
    assert torch.autograd.gradcheck(curve, light.requires_grad_())


def test_psnr_of_a_known_error():
    assert float(psnr_db(torch.full((4, 4), 1e-3))) == pytest.approx(30)
