"""Volume rendering against its twins, finite differences and closed forms."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.operators.compositing import (
    accumulate,
    accumulate_twin,
    volume_weights,
    volume_weights_twin,
)


def pack(counts: list[int]) -> torch.Tensor:
    sizes = torch.tensor(counts, dtype=torch.int64).reshape(-1)
    return torch.stack([sizes.cumsum(0) - sizes, sizes], dim=-1)


def make(counts: list[int], dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    optical_depths = torch.rand(sum(counts), generator=g, dtype=dtype)
    values = torch.randn(sum(counts), 5, generator=g, dtype=dtype)
    return optical_depths, values, pack(counts)


BATCHES = [[], [0], [1], [3, 0, 2], [0, 0, 40, 1, 0], [2] * 600]


@pytest.mark.parametrize("counts", BATCHES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("twins", [(volume_weights, volume_weights_twin), (accumulate, accumulate_twin)])
def test_weights_totals_and_their_gradients_agree_with_the_twins(twins, counts, dtype, device):
    depths, values, packed_info = (x.to(device) for x in make(counts, dtype))
    are_weights = twins[0] is volume_weights
    inputs = [x.requires_grad_() for x in ((depths,) if are_weights else (depths, values))]
    actual, expected = (function(*inputs, packed_info) for function in twins)
    # In float32 the twin's running sum over all rays loses digits that the kernel, which sums ray by ray, has.
    of_weights = {torch.float32: (1e-3, 1e-4), torch.float64: (1e-9, 1e-12)}
    rtol, atol = of_weights[dtype] if are_weights else (None, None)
    assert_close(actual, expected, rtol=rtol, atol=atol)
    drawn = torch.Generator().manual_seed(1)
    cotangent = torch.randn(expected.shape, generator=drawn, dtype=dtype).to(device)
    found, wanted = (torch.autograd.grad(one, inputs, cotangent) for one in (actual, expected))
    assert_close(found, wanted, rtol=rtol, atol=atol)


def test_gradients_are_those_of_finite_differences():
    optical_depths, values, packed_info = make([3, 0, 4])
    inputs = (optical_depths.requires_grad_(), values.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda tau, v: accumulate(volume_weights(tau, packed_info), v, packed_info), inputs
    )


def test_a_slab_of_constant_density_lets_through_what_beer_lambert_says():
    density, thickness, n = 0.7, 3.0, 300
    tau = torch.full((n,), density * thickness / n, dtype=torch.float64, requires_grad=True)
    weights = volume_weights(tau, pack([n]))
    left = math.exp(-density * thickness)
    assert weights.sum().item() == pytest.approx(1 - left, abs=1e-12)
    (slope,) = torch.autograd.grad(weights.sum(), tau, retain_graph=True)
    assert_close(slope, torch.full((n,), left, dtype=torch.float64))
    # Mean distance of the light that comes back from the slab, in closed form.
    t = (torch.arange(n, dtype=torch.float64) + 0.5) * thickness / n
    expected = 1 / density - thickness * left / (1 - left)
    assert ((weights * t).sum() / weights.sum()).item() == pytest.approx(expected, rel=1e-4)


@given(st.lists(st.floats(0, 50), min_size=1, max_size=20))
def test_weights_and_final_transmittance_sum_to_one(depths):
    tau = torch.tensor(depths, dtype=torch.float64)
    weights = volume_weights(tau, pack([len(depths)]))
    assert (weights >= 0).all()
    assert weights.sum().item() + math.exp(-tau.sum().item()) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("extreme", [0.0, 1e-10, 1e10])
def test_extreme_densities_give_finite_values_and_gradients(extreme):
    tau = torch.tensor([extreme, 0.5, extreme], requires_grad=True)
    weights = volume_weights(tau, pack([3]))
    weights.square().sum().backward()
    assert torch.isfinite(weights).all()
    assert tau.grad is not None
    assert torch.isfinite(tau.grad).all()


def test_behind_something_opaque_there_is_exactly_no_light():
    """Numbers between 0 and the smallest of normal exponent are a hundred times slower on a CPU than 0 itself."""
    tau = torch.full((200,), 1.0, requires_grad=True)
    weights = volume_weights(tau, pack([200]))
    cotangent = torch.randn(200, generator=torch.Generator().manual_seed(0))
    (gradient,) = torch.autograd.grad(weights, tau, cotangent)
    for values in (weights.detach(), gradient):
        assert (values[:40] != 0).all()
        assert (values[60:] == 0).all()
        assert (values[values != 0].abs() > 1e-30).all()
