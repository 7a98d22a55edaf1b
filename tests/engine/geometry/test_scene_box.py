"""The box of model space."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.engine.geometry.space import SceneBox

BOX = SceneBox(torch.tensor([[-1.0, -2.0, 0.0], [1.0, 3.0, 0.5]]))
numbers = st.floats(-4.0, 4.0, width=32)
vectors = st.tuples(numbers, numbers, numbers)


def test_corners_normalise_to_zero_and_one():
    assert torch.equal(BOX.normalise(BOX.aabb), torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))


def test_size_is_the_edge_lengths():
    assert torch.equal(BOX.size, torch.tensor([2.0, 5.0, 0.5]))


@given(vectors)
def test_contains_agrees_with_normalised_coordinates(point):
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


def test_a_ray_along_an_axis_on_a_face_gives_finite_distances():
    t_near, t_far = BOX.intersect(torch.tensor([[-1.0, -5.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]))
    assert torch.isfinite(t_near).all()
    assert torch.isfinite(t_far).all()


def test_a_ray_that_misses_has_a_stretch_of_no_length():
    t_near, t_far = BOX.intersect(torch.tensor([[5.0, 5.0, 5.0]]), torch.tensor([[0.0, 1.0, 0.0]]))
    assert t_near.item() == t_far.item()


def test_a_ray_that_leaves_the_box_behind_it_misses():
    t_near, t_far = BOX.intersect(torch.tensor([[0.0, 5.0, 0.25]]), torch.tensor([[0.0, 1.0, 0.0]]))
    assert t_near.item() == t_far.item()


def test_an_inside_out_box_is_refused():
    with pytest.raises(ValueError, match="smaller corner first"):
        SceneBox(torch.tensor([[0.0, 0.0, 0.0], [1.0, -1.0, 1.0]]))
