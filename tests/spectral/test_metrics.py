import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from tests.factories.mixtures import seeded, smooth_endmembers
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral import metrics
from unmix_plugin.spectral.metrics import (
    abundance_rmse,
    endmember_angle,
    match_endmembers,
    psnr,
    psnr_over_white,
    rmse,
    sam,
    spectral_angle,
    ssim,
)

spectra = st.tuples(*[st.floats(0.01, 1)] * 5).map(lambda v: torch.tensor(v, dtype=torch.float64))


def image(seed, height=12, width=15, num_bands=4, low=0.05):
    return low + (1 - low) * torch.rand(height, width, num_bands, dtype=torch.float64, generator=seeded(seed))


def test_psnr_and_rmse_have_their_closed_forms():
    """Over all pixels and bands, not a mean of roots."""
    target = torch.full((3, 4, 2), 0.25)
    assert psnr(target + 0.1, target) == pytest.approx(20, abs=1e-5)
    assert psnr(target + 0.01, target) == pytest.approx(40, abs=1e-4)
    assert rmse(torch.tensor([[[0.6, 0], [0, 0]]]), torch.zeros(1, 2, 2)) == pytest.approx(0.3, rel=1e-6)
    same = image(1)
    assert (psnr(same, same), rmse(same, same), ssim(same, same)) == (math.inf, 0, pytest.approx(1))
    assert sam(same, same) == pytest.approx(0, abs=1e-12)


def test_psnr_over_white_is_that_of_the_images_laid_over_white_few_rows_at_a_time(monkeypatch):
    pred_opacity, target_opacity = image(3)[..., 0], image(4)[..., 0]
    pred, target = (image(seed) * x[..., None] for seed, x in ((1, pred_opacity), (2, target_opacity)))
    valid = image(5)[..., 0] > 0.3
    pred_on_white = pred + 1 - pred_opacity[..., None]
    target_on_white = target + 1 - target_opacity[..., None]
    monkeypatch.setattr(metrics, "_VALUES_AT_ONCE", 150)
    found = psnr_over_white(pred, pred_opacity, target, target_opacity, valid)
    assert found == pytest.approx(psnr(pred_on_white, target_on_white, valid), rel=1e-12)
    assert psnr_over_white(pred, pred_opacity, pred, pred_opacity) == math.inf


@pytest.mark.parametrize("metric", [psnr, rmse, ssim, sam])
def test_predictions_are_clamped_and_a_figure_over_no_pixel_is_nan(metric):
    pred, target = 3 * image(1) - 1, image(2)
    assert metric(pred, target) == metric(pred.clamp(0, 1), target)
    assert math.isnan(metric(pred, target, torch.zeros(12, 15, dtype=torch.bool)))


@pytest.mark.parametrize("metric", [psnr, rmse, ssim])
def test_pixels_outside_the_valid_mask_do_not_count_even_if_nan(metric):
    pred, target = image(1), image(2)
    valid = torch.rand(12, 15, generator=seeded(5)) > 0.3
    spoiled = torch.where(valid[..., None], target, torch.nan)
    value = metric(pred, spoiled, valid)
    assert math.isfinite(value)
    assert value == metric(torch.where(valid[..., None], pred, 0.9), spoiled, valid)
    assert value != metric(pred, target)
    assert metric(pred, target, torch.ones_like(valid)) == pytest.approx(metric(pred, target))


def test_ssim_is_the_published_formula_over_7_by_7_windows():
    pred, target = image(3, num_bands=2), image(4, num_bands=2)
    values = []
    for band in range(2):
        for row in range(12 - 6):
            for column in range(15 - 6):
                x, y = (im[row : row + 7, column : column + 7, band].numpy().ravel() for im in (pred, target))
                covariance = np.cov(x, y)  # normalised by n - 1
                numerator = (2 * x.mean() * y.mean() + 0.01**2) * (2 * covariance[0, 1] + 0.03**2)
                spread = covariance[0, 0] + covariance[1, 1] + 0.03**2
                values.append(numerator / ((x.mean() ** 2 + y.mean() ** 2 + 0.01**2) * spread))
    assert ssim(pred, target) == pytest.approx(float(np.mean(values)), rel=1e-9)
    with pytest.raises(SpectrumError, match="at least 7 x 7 pixels; found 6 x 15"):
        ssim(image(1, height=6), image(2, height=6))


@given(spectra, spectra, spectra, st.floats(0.01, 100), st.floats(0.01, 100))
def test_spectral_angle_is_a_metric_that_ignores_brightness(a, b, c, gain_a, gain_b):
    angle = spectral_angle(a, b)
    assert_close(spectral_angle(gain_b * b, gain_a * a), angle, atol=1e-12, rtol=0)
    assert 0 <= float(angle) <= math.pi / 2
    assert float(spectral_angle(a, c)) <= float(angle + spectral_angle(b, c)) + 1e-12


@pytest.mark.parametrize("angle", [1e-12, 1e-6, 0.1, math.pi / 2, math.pi - 1e-6, math.pi])
def test_spectral_angle_is_precise_everywhere_and_a_right_angle_to_nothing(angle):
    a = torch.tensor([1.0, 0.0], dtype=torch.float64)
    b = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    assert float(spectral_angle(a, b)) == pytest.approx(angle, rel=1e-9)
    assert float(spectral_angle(0 * a, b)) == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("pair", [(1, 1), (1, 2), (1, -1), (0, 1), (0, 0)])
def test_spectral_angle_has_right_gradients_finite_at_parallel_opposite_and_zero_spectra(pair, dtype):
    base = torch.tensor([0.3, 0.5, 0.1], dtype=dtype)
    a, b = (torch.nn.Parameter(gain * base) for gain in pair)
    for gradient in torch.autograd.grad(spectral_angle(a, b), (a, b)):
        assert torch.isfinite(gradient).all()
        assert float(gradient.abs().max()) < 100
    some = torch.rand(2, 3, 5, dtype=torch.float64, generator=seeded(1), requires_grad=True)
    assert torch.autograd.gradcheck(spectral_angle, tuple(some.unbind()))


def test_sam_is_the_mean_angle_over_masked_pixels_that_are_not_dark():
    target = torch.tensor([[[0.5, 0.0], [0.5, 0.0], [0.004, 0.004], [0.2, 0.0]]])
    pred = torch.tensor([[[0.3, 0.3], [0.0, 0.9], [0.0, 0.5], [0.9, 0.0]]])
    everything = [math.pi / 4, math.pi / 2, 0]
    assert sam(pred, target) == pytest.approx(sum(everything) / 3)
    mask = torch.tensor([[True, False, True, True]])
    assert sam(pred, target, mask) == pytest.approx((math.pi / 4 + 0) / 2)
    assert math.isnan(sam(target[..., :1], pred[..., :1]))  # numbers of one band have no angle
    bright = torch.rand(1, 1, 100, generator=seeded())
    angles = [sam(bright, torch.full((1, 1, 100), value)) for value in (0.0049, 0.0051)]
    assert np.isnan(angles).tolist() == [True, False]


@given(st.permutations(range(5)))
def test_endmembers_are_matched_whatever_their_order_and_brightness(order):
    true = smooth_endmembers(5)
    pred = true[list(order)] * torch.linspace(0.2, 1, 5, dtype=torch.float64)[:, None]
    matching = match_endmembers(pred, true)
    assert matching.true_ids == tuple(range(5))
    assert [order[p] for p in matching.pred_ids] == list(range(5))
    assert max(matching.angles) < 1e-7


def test_matching_minimises_the_sum_not_each_angle():
    true, pred = (torch.tensor(degrees).deg2rad() for degrees in ((40.0, 0.0), (30.0, 89.0)))
    true, pred = (torch.stack([angles.cos(), angles.sin()], dim=1) for angles in (true, pred))
    # Greedy: 40-30 then 0-89 sums to 99 degrees; the best pairing is 40-89 and 0-30, 79 degrees.
    matching = match_endmembers(pred, true)
    assert dict(zip(matching.true_ids, matching.pred_ids, strict=True)) == {0: 1, 1: 0}
    assert sum(matching.angles) == pytest.approx(math.radians(79), abs=1e-6)


def test_endmember_angle_is_the_mean_over_true_materials_and_counts_what_is_missing():
    """A missing material as a right angle; surplus ones not."""
    true = smooth_endmembers(4) * torch.linspace(1, 0.2, 24, dtype=torch.float64)
    assert endmember_angle(0.3 * true[[2, 0, 3, 1]], true) == pytest.approx(0, abs=1e-7)
    assert endmember_angle(true[:3], true) == pytest.approx(math.pi / 8, abs=1e-7)
    surplus = torch.cat([true, torch.rand(2, 24, dtype=torch.float64, generator=seeded())])
    assert endmember_angle(surplus, true) == pytest.approx(0, abs=1e-7)


def test_abundance_rmse_is_taken_after_matching_over_pixels_with_truth():
    endmembers = smooth_endmembers(3)
    order = [2, 0, 1]
    true = torch.rand(4, 5, 3, dtype=torch.float64, generator=seeded(1))
    true = true / true.sum(-1, keepdim=True)
    true[0] = 0
    matching = match_endmembers(endmembers[order], endmembers)
    pred = true[..., order].clone()
    assert abundance_rmse(pred, true, matching) == 0
    assert abundance_rmse(true, true, matching) > 0.1
    pred[0] = 0.7
    assert abundance_rmse(pred, true, matching) == 0
    assert abundance_rmse(pred, true, matching, torch.ones(4, 5, dtype=torch.bool)) == pytest.approx(0.7 / 2)
    pred[2, 3, 0] = true[2, 3, 2] - 0.6 if true[2, 3, 2] > 0.6 else true[2, 3, 2] + 0.3
    step = float((pred[2, 3, 0] - true[2, 3, 2]).abs())
    assert abundance_rmse(pred, true, matching) == pytest.approx(step / math.sqrt(15 * 3))


def test_unmatched_materials_count_as_absent_and_surplus_ones_have_no_column():
    endmembers = smooth_endmembers(3)
    true = torch.zeros(1, 1, 3, dtype=torch.float64)
    true[..., 0], true[..., 2] = 0.4, 0.6
    fewer = match_endmembers(endmembers[:2], endmembers)
    assert abundance_rmse(true[..., :2], true, fewer) == pytest.approx(0.6 / math.sqrt(3))
    more = match_endmembers(torch.cat([endmembers[:1] ** 3, endmembers]), endmembers)
    pred = torch.cat([torch.full((1, 1, 1), 0.9, dtype=torch.float64), true], dim=-1)
    assert more.pred_ids == (1, 2, 3)
    assert abundance_rmse(pred, true, more) == 0


class Largest(TorchDispatchMode):
    """Remembers the most values that any new tensor in float64 had."""

    values = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if isinstance(result, Tensor) and result.dtype == torch.float64 and not result._is_view():
            self.values = max(self.values, result.numel())
        return result


def test_cubes_are_scored_a_few_rows_at_a_time_with_the_same_result(monkeypatch):
    pred, target = (image(seed, 40, 30, 16).float() for seed in (1, 2))
    valid = torch.rand(40, 30, generator=seeded(5)) > 0.3
    figures = (psnr, rmse, sam, ssim)
    expected = [figure(pred, target, valid) for figure in figures]
    monkeypatch.setattr(metrics, "_VALUES_AT_ONCE", 1500)
    with Largest() as largest:
        found = [figure(pred, target, valid) for figure in figures]
    assert found == pytest.approx(expected, rel=1e-12)
    assert 0 < largest.values <= 1500  # of 19,200
