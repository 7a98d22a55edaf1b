"""Marching through contracted space against its twin and closed forms."""

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.operators.marching import (
    FAR_RADIUS,
    LINEAR_RADIUS,
    march_contracted_twin,
    rays_in_world,
)
from unmix_plugin.operators.occupancy import skip_distances


def make_rays(num_rays: int, seed: int = 0):
    """Rays from in and around the inner cube."""
    g = torch.Generator().manual_seed(seed)
    origins = 2.5 * torch.randn(num_rays, 3, generator=g)
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=g), dim=-1)
    return origins, directions, torch.rand(num_rays, generator=g)


def march(origins, directions, jitter, skips, step):
    return rays_in_world(origins, directions, torch.zeros_like(jitter), jitter, skips, step).samples()


@pytest.mark.parametrize("num_rays", [0, 1, 300])
@pytest.mark.parametrize(
    ("sides", "share"), [((8, 8, 8), 0.3), ((3, 5, 7), 0.3), ((1, 1, 1), 0.3), ((48, 40, 44), 3e-3)]
)
def test_kernel_and_twin_take_the_same_samples(num_rays, sides, share, device):
    occupied = torch.rand(sides, generator=torch.Generator().manual_seed(3)) < share
    skips = skip_distances(occupied).to(device)
    origins, directions, jitter = (values.to(device) for values in make_rays(num_rays))
    found = march(origins, directions, jitter, skips, 0.05)
    expected = march_contracted_twin(origins, directions, torch.zeros_like(jitter), jitter, skips, 0.05)
    # A sample within rounding of a cell's face may fall to either side.
    differing = (found.packed_info[:, 1] - expected.packed_info[:, 1]).abs()
    same = differing == 0
    assert num_rays < 300 or same.float().mean() > 0.95
    assert int(differing.sum()) <= 0.002 * len(expected) + 1
    kept = [samples.select(same[samples.ray_indices]) for samples in (found, expected)]
    assert torch.equal(kept[0].ray_indices, kept[1].ray_indices)
    close = (kept[0].t - kept[1].t).abs() <= 1e-3 * kept[1].t.clamp(min=0.01)
    assert num_rays < 300 or close.float().mean() > 0.995


@pytest.mark.parametrize("most", [1, 7, 1000])
def test_the_first_samples_and_what_follows_are_those_of_all(most, device):
    occupied = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(3)) < 0.3
    skips = skip_distances(occupied).to(device)
    origins, directions, _ = (values.to(device) for values in make_rays(200))
    middles = torch.full_like(origins[:, 0], 0.5)
    samples = march(origins, directions, middles, skips, 0.05)
    starts, counts = samples.packed_info.unbind(-1)
    ends = torch.zeros_like(origins[:, 0])
    for before in (0, most):
        found = rays_in_world(origins, directions, ends, middles, skips, 0.05).first_samples(most)
        assert torch.equal(found.counts, (counts - before).clamp(0, most))
        is_written = torch.arange(most, device=device) < found.counts[:, None]
        rows = (starts[:, None] + before + torch.arange(most, device=device))[is_written]
        assert torch.equal(found.t[is_written], samples.t[rows])
        ends = found.ends


@pytest.mark.parametrize("step", [0.05, 0.001])
def test_samples_are_a_step_apart_in_the_inner_cube_and_then_farther_up_to_the_far_end(step):
    full = torch.zeros(4, 4, 4, dtype=torch.uint8)
    origins, directions = torch.tensor([[0.0, 0.1, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    samples = march(origins, directions, torch.zeros(1), full, step)
    gaps = samples.t.diff()
    radius = samples.t[:-1].clamp(min=1.0)
    assert_close(gaps, step * radius * (radius / LINEAR_RADIUS).clamp(min=1.0), rtol=2e-3, atol=1e-5)
    assert samples.t[-1] <= FAR_RADIUS
    assert samples.t[-1] + gaps[-1] > FAR_RADIUS / 2
    # The number of samples: inner cube, then ln(r) and 1/r to infinity.
    assert len(samples) == pytest.approx((1 + 0.693 + 1) / step, rel=0.1)


def test_a_ray_from_beyond_the_far_end_has_no_samples_and_steps_of_no_length_are_refused():
    full = torch.zeros(4, 4, 4, dtype=torch.uint8)
    origins, directions = torch.tensor([[600.0, 0.0, 0.0]]), torch.tensor([[-1.0, 0.0, 0.0]])
    assert len(march(origins, directions, torch.zeros(1), full, 0.05)) == 0
    with pytest.raises(ValueError, match="step must be positive"):
        march(*make_rays(3), full, 0.0)
