"""The hash encoding against its twin, finite differences and closed forms."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.operators.hash_encoding import HashGridLayout, hash_encode, hash_encode_twin

DENSE = HashGridLayout(2, 4, 3, 5, 10)
HASHED = HashGridLayout(3, 4, 4, 40, 8)
NARROW = HashGridLayout(2, 1, 2, 9, 6)
"""Of one feature a level: each width and precision is a kernel to compile."""


def make(layout: HashGridLayout, num_samples: int, dtype=torch.float32, device="cpu", seed=0):
    g = torch.Generator().manual_seed(seed)
    positions = torch.rand(num_samples, 3, generator=g, dtype=torch.float64)
    table = torch.randn(layout.num_rows, layout.features_per_level, generator=g, dtype=torch.float64)
    return positions.to(device, dtype), table.to(device, dtype)


@pytest.mark.parametrize("num_samples", [0, 1, 7, 700])
@pytest.mark.parametrize(
    ("layout", "dtype"),
    [(DENSE, torch.float32), (HASHED, torch.float32), (HASHED, torch.float64), (NARROW, torch.float32)],
)
def test_kernel_and_twin_agree_in_value_and_every_gradient(layout, num_samples, dtype, device):
    positions, table = make(layout, num_samples, dtype, device)
    for tensor in (positions, table):
        tensor.requires_grad_()
    actual, expected = hash_encode(positions, table, layout), hash_encode_twin(positions, table, layout)
    assert_close(actual, expected)
    drawn = torch.Generator().manual_seed(1)
    cotangent = torch.randn(expected.shape, generator=drawn, dtype=dtype).to(device)
    found = torch.autograd.grad(actual, (positions, table), cotangent)
    wanted = torch.autograd.grad(expected, (positions, table), cotangent)
    assert_close(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("layout", [DENSE, HASHED])
def test_gradients_are_those_of_finite_differences(layout):
    positions, table = make(layout, 5, torch.float64)
    for tensor in (positions, table):
        tensor.requires_grad_()
    assert torch.autograd.gradcheck(lambda p, t: hash_encode(p, t, layout), (positions, table), eps=1e-7)


def test_a_second_backward_pass_gives_the_same_gradient():
    positions, table = make(HASHED, 300)
    table.requires_grad_()
    gradients = [torch.autograd.grad(hash_encode(positions, table, HASHED).sum(), table)[0] for _ in range(2)]
    assert torch.equal(*gradients)


def test_a_field_linear_in_position_is_reproduced_exactly():
    layout = HashGridLayout(1, 4, 4, 4, 8)
    side = layout.levels[0, 0].item() + 1
    z, y, x = torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij")
    vertices = torch.stack([x, y, z], dim=-1).reshape(-1, 3).double() / (side - 1)
    positions, _ = make(layout, 50, torch.float64)
    table = torch.cat([vertices, vertices.sum(dim=1, keepdim=True) + 1], dim=1)
    encoded = hash_encode(positions, table, layout)
    assert_close(encoded[:, :3], positions)
    assert_close(encoded[:, 3], positions.sum(dim=1) + 1)


@given(st.integers(0, 2**31 - 1))
def test_encoding_is_linear_in_the_table(seed):
    positions, table = make(HASHED, 20, torch.float64, seed=seed)
    other = make(HASHED, 20, torch.float64, seed=seed + 1)[1]
    both = hash_encode(positions, 2 * table + other, HASHED)
    assert_close(both, 2 * hash_encode(positions, table, HASHED) + hash_encode(positions, other, HASHED))


def test_levels_grow_geometrically_and_lie_one_behind_the_other():
    levels = HashGridLayout(8, 4, 16, 256, 17).levels
    assert levels[:, 0].tolist() == [16, 23, 35, 52, 78, 115, 172, 256]
    assert levels[0].tolist() == [16, 0, 17**3]
    assert levels[-1, 2] == 2**17
    assert torch.equal(levels[1:, 1], (levels[:, 1] + levels[:, 2])[:-1])


def test_a_table_of_another_shape_is_refused():
    positions, table = make(DENSE, 3)
    with pytest.raises(ValueError, match=r"table must have shape \(\d+, 4\)"):
        hash_encode(positions, table[:-1], DENSE)


def test_a_known_encoding_is_taken_over_with_the_gradients_of_a_computed_one():
    positions, table = make(HASHED, 60)
    for tensor in (positions, table):
        tensor.requires_grad_()
    computed = hash_encode(positions, table, HASHED)
    taken = hash_encode(positions, table, HASHED, known=computed.detach())
    assert torch.equal(taken, computed)
    cotangent = torch.randn_like(computed)
    inputs = (positions, table)
    assert_close(*(torch.autograd.grad(encoded, inputs, cotangent) for encoded in (taken, computed)))
