"""Bundles of rays, the box of model space, and laws of the contraction of space."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from unmix_plugin.engine.geometry.space import RayBundle, SceneBox, UnitSpace, contract, uncontract


def make_bundle(count: int) -> RayBundle:
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(count, 3, generator=generator)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return RayBundle(torch.randn(count, 3, generator=generator), directions, torch.arange(count))


def test_a_part_of_a_bundle_keeps_each_ray_together_and_joined_parts_are_one_after_the_other():
    bundle = make_bundle(7)
    for index in (slice(2, 5), torch.tensor([4, 0, 4]), torch.arange(7) % 3 == 0):
        part, again = bundle[index], RayBundle.join([bundle[index], bundle[index]])
        assert part.axes is again.axes is None
        for name in ("origins", "directions", "camera_indices"):
            expected = getattr(bundle, name)[index]
            assert torch.equal(getattr(part, name), expected)
            assert torch.equal(getattr(again, name), torch.cat([expected, expected]))


BOX = SceneBox(torch.tensor([[-1.0, -2.0, 0.0], [1.0, 3.0, 0.5]]))
numbers = st.floats(-4.0, 4.0, width=32)
vectors = st.tuples(numbers, numbers, numbers)


@given(vectors)
def test_contains_agrees_with_normalised_coordinates(point):
    assert torch.equal(BOX.normalise(BOX.aabb), torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    p = torch.tensor(point)
    normalised = BOX.normalise(p)
    clear = ((normalised - 0.5).abs() - 0.5).abs().min() > 1e-5  # rounding decides on the surface itself
    if clear:
        assert bool(BOX.contains(p)) == bool(((normalised >= 0) & (normalised <= 1)).all())


@given(vectors, vectors.filter(lambda v: max(map(abs, v)) > 0.1))
def test_the_stretch_inside_is_exactly_what_intersect_says(origin, direction):
    o, d = torch.tensor([origin]), torch.tensor([direction])
    d = d / d.norm()
    t_near, t_far = BOX.intersect(o, d)
    assert 0.0 <= t_near.item() <= t_far.item()
    t = torch.linspace(0.0, 20.0, 801)
    points = o + t[:, None] * d
    within = (t > t_near + 1e-3) & (t < t_far - 1e-3)
    beyond = (t < t_near - 1e-3) | (t > t_far + 1e-3)
    assert grown_box(1e-3).contains(points[within]).all()
    assert not grown_box(-1e-3).contains(points[beyond]).any()


def grown_box(margin: float) -> SceneBox:
    return SceneBox(BOX.aabb + torch.tensor([[-margin], [margin]]))


@pytest.mark.parametrize("origin", [[5.0, 5.0, 5.0], [0.0, 5.0, 0.25]], ids=["beside", "behind"])
def test_a_ray_that_misses_has_a_stretch_of_no_length_and_one_on_a_face_a_finite_one(origin):
    along = torch.tensor([[0.0, 1.0, 0.0]])
    t_near, t_far = BOX.intersect(torch.tensor([origin]), along)
    assert t_near.item() == t_far.item()
    assert all(torch.isfinite(t).all() for t in BOX.intersect(torch.tensor([[-1.0, -5.0, 0.0]]), along))
    with pytest.raises(ValueError, match="smaller corner first"):
        SceneBox(torch.tensor([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0]]))


OBLONG = SceneBox(torch.tensor([[-1.0, 0.0, 2.0], [3.0, 1.0, 5.0]]))
POINTS = st.lists(st.floats(-100, 100, width=32), min_size=3, max_size=3).map(torch.tensor)


@given(POINTS, POINTS)
def test_contraction_brings_points_nearer_and_is_continuous(a, b):
    """Its greatest stretch is 1, inside the inner cube and across its faces."""
    moved = (contract(a.double()) - contract(b.double())).abs().amax()
    assert moved <= 2 * (a.double() - b.double()).abs().amax() + 1e-12
    near = contract(a.double() * (1 + 1e-9)) - contract(a.double())
    assert near.abs().amax() < 1e-8


@given(POINTS)
def test_contraction_stays_below_two_leaves_the_inner_cube_alone_and_is_undone(point):
    point = point.double()
    found = contract(point)
    assert found.abs().amax() < 2
    assert_close(uncontract(found), point, rtol=1e-6, atol=1e-9)
    assert torch.equal(contract(point / 100), point / 100)
    far = contract(torch.tensor([1e6, 0.0, 5e5]))
    assert_close(far, torch.tensor([2.0, 0.0, 1.0]), rtol=0, atol=1e-5)  # the end of a direction


def test_the_unit_cube_of_a_bounded_scene_is_its_box_to_the_last_bit():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    space = UnitSpace(OBLONG)
    assert torch.equal(space.to_unit(points), OBLONG.normalise(points))
    assert torch.equal(space.from_unit(points), points * OBLONG.size + OBLONG.aabb[0])
    assert torch.equal(space.contains(points), OBLONG.contains(points))


def test_the_unit_cube_of_an_unbounded_scene_holds_all_of_space_and_the_box_in_its_middle():
    space = UnitSpace(OBLONG, is_unbounded=True)
    far = 1000 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    unit = space.to_unit(far)
    assert ((unit > 0) & (unit < 1)).all()
    assert space.contains(far).all()
    assert_close(space.from_unit(space.to_unit(far / 100)), far / 100, rtol=1e-3, atol=1e-3)
    assert_close(space.to_unit(OBLONG.aabb)[:, 0], torch.tensor([0.25, 0.75]))
