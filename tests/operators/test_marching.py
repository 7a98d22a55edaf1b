"""Marching through an occupancy grid against its twin and closed forms."""

import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.operators.marching import PackedSamples, march_twin, rays_in_box
from unmix_plugin.operators.occupancy import skip_distances


def make_rays(num_rays: int, seed: int = 0):
    """Rays that cross the unit cube, with their entry and exit."""
    g = torch.Generator().manual_seed(seed)
    inside = torch.rand(num_rays, 3, generator=g)
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=g), dim=-1)
    origins = inside - 3 * directions
    to_low, to_high = -origins / directions, (1 - origins) / directions
    t_near = torch.minimum(to_low, to_high).amax(-1)
    t_far = torch.maximum(to_low, to_high).amin(-1)
    return origins, directions, t_near, t_far, torch.rand(num_rays, generator=g)


def march(*given):
    return rays_in_box(*given).samples()


@pytest.mark.parametrize("num_rays", [0, 1, 5, 900])
@pytest.mark.parametrize("sides", [(8, 8, 8), (3, 5, 7), (1, 1, 1)])
def test_kernel_and_twin_take_the_same_samples(num_rays, sides, device):
    step, longest = 0.013, 3**0.5
    occupied = torch.rand(sides, generator=torch.Generator().manual_seed(3)) < 0.3
    o, d, t_near, t_far, jitter = (x.to(device) for x in make_rays(num_rays))
    lattice = (t_near + jitter * step)[:, None] + torch.arange(int(longest / step) + 2, device=device) * step
    taken = []
    for function in (march, march_twin):
        samples = function(o, d, t_near, t_far, jitter, skip_distances(occupied).to(device), step)
        ray, count = samples.ray_indices, samples.packed_info[:, 1]
        indices = ((samples.t - lattice[ray, 0]) / step).round().long()
        assert_close(samples.t, lattice[ray, indices], rtol=0, atol=2e-6)
        assert torch.equal(ray, torch.arange(num_rays, device=device).repeat_interleave(count))
        assert torch.equal(samples.packed_info[:, 0], count.cumsum(0) - count)
        is_taken = torch.zeros_like(lattice, dtype=torch.bool)
        is_taken[ray, indices] = True
        taken.append(is_taken)
    # A sample within rounding of a cell's face or of the far end may fall to either side.
    scaled = (o[:, None] + lattice[..., None] * d[:, None]) * torch.tensor(sides, device=device)
    is_clear = ((scaled - scaled.round()).abs() > 1e-4).all(-1) & ((lattice - t_far[:, None]).abs() > 1e-5)
    assert num_rays == 0 or is_clear.double().mean() > 0.99
    assert torch.equal(taken[0][is_clear], taken[1][is_clear])


@pytest.mark.parametrize("step", [1 / 64, 0.1, 0.05, 1 / 3, 0.013, 2.0])
def test_every_lattice_point_in_front_of_the_far_end_is_taken_and_none_at_it(step):
    n = 200
    origins, directions = torch.full((n, 3), 0.5), torch.tensor([[0.25, 0.0, 0.0]]).repeat(n, 1)
    g = torch.Generator().manual_seed(0)
    t_near, jitter = torch.rand(n, generator=g), torch.rand(n, generator=g)
    jitter[: n // 2] = 0.0
    # Far ends lie on a lattice point, as little behind one as can be, or anywhere.
    t_far = t_near + jitter * step + torch.arange(n) * step
    t_far[1::3] = torch.nextafter(t_far[1::3], torch.tensor(torch.inf))
    t_far[2::3] += torch.rand(len(t_far[2::3]), generator=g) * step
    samples = march(origins, directions, t_near, t_far, jitter, torch.zeros(2, 2, 2).byte(), step)
    lattice = (t_near + jitter * step)[:, None] + torch.arange(n + 3) * step
    assert torch.equal(samples.packed_info[:, 1], (lattice < t_far[:, None]).sum(dim=1))


@pytest.mark.parametrize("share", [1e-3, 5e-3, 0.05])
@pytest.mark.parametrize("step", [0.002, 0.03, 0.3])
def test_what_is_passed_over_by_clearance_is_empty(share, step):
    rays = make_rays(2000)
    occupied = torch.rand(40, 30, 50, generator=torch.Generator().manual_seed(1)) < share
    skips = skip_distances(occupied)
    passing, looking = (march(*rays, grid, step) for grid in (skips, skips.clamp(max=1)))
    assert skips.max() > 2
    assert len(looking) > 0
    assert torch.equal(passing.packed_info, looking.packed_info)
    assert torch.equal(passing.t, looking.t)
    assert torch.equal(passing.ray_indices, looking.ray_indices)


def test_only_the_occupied_slab_is_sampled_and_its_samples_measure_it():
    occupied = torch.zeros(8, 1, 1, dtype=torch.bool)
    occupied[2:5] = True
    n = 64
    origins = torch.tensor([[-1.0, 0.5, 0.5]]).repeat(n, 1)
    directions = torch.tensor([[1.0, 0.0, 0.0]]).repeat(n, 1)
    skips = skip_distances(occupied)
    samples = march(origins, directions, torch.ones(n), 2 * torch.ones(n), torch.arange(n) / n, skips, 0.03)
    x = samples.t - 1
    assert (x >= 0.25 - 1e-6).all()
    assert (x <= 0.625 + 1e-6).all()
    # Over evenly spread jitter the mean count times the step is the slab's thickness.
    assert len(samples) / n * 0.03 == pytest.approx(0.375, abs=1e-3)


def test_rays_that_miss_or_meet_nothing_have_no_samples_and_steps_of_no_length_are_refused():
    origins, directions, t_near, t_far, jitter = make_rays(6)
    nothing, full = skip_distances(torch.zeros(4, 4, 4, dtype=torch.bool)), torch.zeros(4, 4, 4).byte()
    empty = march(origins, directions, t_near, t_far, jitter, nothing, 0.05)
    missed = march(origins, directions, t_near, t_near, jitter, full, 0.05)
    assert len(empty) == len(missed) == 0
    assert empty.packed_info[:, 1].tolist() == [0] * 6
    with pytest.raises(ValueError, match="step must be positive; got 0"):
        march(*make_rays(2), full, 0.0)


@pytest.mark.parametrize("most", [1, 5, 200])
def test_the_first_samples_and_what_follows_are_those_of_all(most, device):
    skips = skip_distances(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(3)) < 0.3).to(device)
    o, d, t_near, t_far, _ = (x.to(device) for x in make_rays(300))
    middles = torch.full_like(t_near, 0.5)
    samples = march(o, d, t_near, t_far, middles, skips, 0.013)
    starts, counts = samples.packed_info.unbind(-1)
    for before, rounding in ((0, 0.0), (most, 0.02)):
        found = rays_in_box(o, d, t_near, t_far, middles, skips, 0.013).first_samples(most)
        # The same lattice but for rounding, by which a sample may fall to either side of a cell's face.
        same = found.counts == (counts - before).clamp(0, most)
        assert same.double().mean() >= 1 - rounding
        written = same[:, None] & (torch.arange(most, device=device) < found.counts[:, None])
        rows = (starts[:, None] + before + torch.arange(most, device=device))[written]
        close = (found.t[written] - samples.t[rows]).abs() <= (2e-6 if rounding else 0.0)
        assert len(close) == 0 or close.double().mean() >= 1 - rounding
        t_near = torch.where(found.counts == most, found.ends, t_far)


def test_selecting_samples_keeps_them_packed_by_ray():
    samples = PackedSamples(
        torch.arange(5.0), torch.tensor([0, 0, 2, 2, 2]), torch.tensor([[0, 2], [2, 0], [2, 3]])
    )
    kept = samples.select(torch.tensor([False, True, True, False, True]))
    assert kept.t.tolist() == [1.0, 2.0, 4.0]
    assert kept.ray_indices.tolist() == [0, 2, 2]
    assert kept.packed_info.tolist() == [[0, 1], [1, 0], [1, 2]]


def test_rays_have_all_their_samples_however_many(device):
    full = torch.zeros(2, 2, 2, dtype=torch.uint8, device=device)
    o, d, t_near, t_far, start = (values.to(device) for values in make_rays(3))
    found, expected = (function(o, d, t_near, t_far, start, full, 3e-4) for function in (march, march_twin))
    assert int(found.packed_info[:, 1].max()) > 1024
    assert (found.packed_info[:, 1] - expected.packed_info[:, 1]).abs().max() <= 1
