"""Laws of the contraction of space."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.engine.geometry.space import SceneBox, UnitSpace, contract, uncontract

BOX = SceneBox(torch.tensor([[-1.0, 0.0, 2.0], [3.0, 1.0, 5.0]]))
POINTS = st.lists(st.floats(-100, 100, width=32), min_size=3, max_size=3).map(torch.tensor)


@given(POINTS)
def test_uncontract_inverts_contract(point):
    found = uncontract(contract(point.double()))
    assert_close(found, point.double(), rtol=1e-6, atol=1e-9)


@given(POINTS, POINTS)
def test_contraction_brings_points_nearer_and_is_continuous(a, b):
    """Its greatest stretch is 1, inside the inner cube and across its faces."""
    moved = (contract(a.double()) - contract(b.double())).abs().amax()
    assert moved <= 2 * (a.double() - b.double()).abs().amax() + 1e-12
    near = contract(a.double() * (1 + 1e-9)) - contract(a.double())
    assert near.abs().amax() < 1e-8


@given(POINTS)
def test_contraction_stays_below_two_and_leaves_the_inner_cube_alone(point):
    found = contract(point.double())
    assert found.abs().amax() < 2
    inner = point.double() / 100
    assert torch.equal(contract(inner), inner)


def test_the_far_end_of_a_direction_lies_on_the_outer_cube():
    assert_close(contract(torch.tensor([1e6, 0.0, 5e5])), torch.tensor([2.0, 0.0, 1.0]), rtol=0, atol=1e-5)


def test_the_unit_cube_of_a_bounded_scene_is_its_box_to_the_last_bit():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    space = UnitSpace(BOX)
    assert torch.equal(space.to_unit(points), BOX.normalise(points))
    assert torch.equal(space.from_unit(points), points * BOX.size + BOX.aabb[0])
    assert torch.equal(space.contains(points), BOX.contains(points))


def test_the_unit_cube_of_an_unbounded_scene_holds_all_of_space_and_the_box_in_its_middle():
    space = UnitSpace(BOX, is_unbounded=True)
    far = 1000 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    unit = space.to_unit(far)
    assert ((unit > 0) & (unit < 1)).all()
    assert space.contains(far).all()
    assert_close(space.from_unit(space.to_unit(far / 100)), far / 100, rtol=1e-3, atol=1e-3)
    assert_close(space.to_unit(BOX.aabb)[:, 0], torch.tensor([0.25, 0.75]))
