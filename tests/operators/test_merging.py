"""Merging samples against its twin, and what it keeps."""

import pytest
import torch
from torch.testing import assert_close

from tests.operators.test_compositing import BATCHES, pack
from unmix_plugin.operators.compositing import accumulate, volume_weights
from unmix_plugin.operators.merging import MergeLimits, merge_samples, merge_samples_twin

STEP = 0.1


def make(counts: list[int], depth: float = 0.5):
    """Depths, distances with gaps, features, which samples are whose, and light that is transmittance."""
    g = torch.Generator().manual_seed(0)
    total = sum(counts)
    depths = depth * torch.rand(total, generator=g).square()
    t = STEP * (1 + 2.0 * (torch.rand(total, generator=g) < 0.1)).cumsum(0)
    return depths, t, torch.randn(total, 5, generator=g), pack(counts), torch.rand(len(counts), generator=g)


@pytest.mark.parametrize("counts", BATCHES)
@pytest.mark.parametrize(("smallest", "most"), [(0.0, 0.0), (0.01, 0.2), (0.05, 0.1), (0.0, 2.0)])
def test_kernel_and_twin_agree(counts, smallest, most, device):
    inputs, limits = make(counts), MergeLimits(STEP, smallest, most)
    depths, t, features, packed_info, transmittance = (value.to(device) for value in inputs)
    found = merge_samples(depths, t, features, packed_info, transmittance, limits)
    depths, t, features, packed_info, transmittance = inputs
    expected = merge_samples_twin(depths, t, features, packed_info, transmittance, limits)
    for name in ("ray_indices", "packed_info"):
        assert torch.equal(getattr(found, name).cpu(), getattr(expected, name))
    for name in ("weights", "t", "features", "transmittance"):
        assert_close(getattr(found, name).cpu(), getattr(expected, name), rtol=1e-4, atol=1e-5)


def test_unmerged_samples_have_the_weights_of_volume_rendering():
    depths, t, features, packed_info, _ = make([3, 0, 30, 1])
    found = merge_samples(depths, t, features, packed_info, torch.ones(4), MergeLimits(STEP, 0.0, 0.0))
    weights = volume_weights(depths, packed_info)
    assert_close(found.weights, weights[weights > 0])
    assert_close(found.features, features[weights > 0])
    ones = torch.ones(len(found.t), 1)
    assert_close(accumulate(found.weights, ones, found.packed_info)[:, 0], 1 - found.transmittance)


def test_merging_keeps_weighted_sums_and_keeps_to_its_limits():
    depths, t, features, packed_info, transmittance = make([20, 5, 0, 400], depth=0.1)
    alone, merged = (
        merge_samples(depths, t, features, packed_info, transmittance, MergeLimits(STEP, 0.0, most))
        for most in (0.0, 0.1)
    )
    assert len(merged.t) < 0.6 * len(alone.t)
    assert merged.weights.max() <= max(0.1, float(alone.weights.max()))
    sums = [
        accumulate(x.weights, torch.cat([x.t[:, None], x.features], dim=-1), x.packed_info)
        for x in (alone, merged)
    ]
    assert_close(sums[0], sums[1], rtol=1e-4, atol=1e-5)
    assert_close(alone.transmittance, merged.transmittance)


def test_samples_before_and_behind_empty_space_stay_apart():
    t = torch.tensor([1.0, 1.1, 3.0, 3.1])
    limits = MergeLimits(STEP, 0.0, 1.0)
    found = merge_samples(torch.full((4,), 0.1), t, t[:, None], pack([4]), torch.ones(1), limits)
    assert found.packed_info.tolist() == [[0, 2]]
    assert_close(found.t, torch.tensor([1.05, 3.05]), atol=5e-3, rtol=0)
