import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.factories.demo_parts import PLACEMENTS, row
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive, first_hits

coordinates = st.floats(-0.9, 0.9)


@given(coordinates, coordinates, st.floats(0.2, 3.0))
def test_a_sphere_is_hit_where_the_quadratic_formula_says(x, y, radius):
    sphere = PlacedPrimitive("sphere", (0.5, -0.25, 1.0), (radius,) * 3, turn_deg=40.0, tilt_deg=-20.0)
    origin, direction = row(0.5 + radius * x, -0.25 + radius * y, 9.0), row(0, 0, -1)
    distance = sphere.entry_distances(origin, direction)
    reach = 1 - x**2 - y**2
    assume(abs(reach) > 1e-3)
    expected = 8 - radius * np.sqrt(reach) if reach > 0 else np.inf
    assert_allclose(distance, expected, rtol=1e-3)


EXTENT = {"sphere": [[0, 1, 2]], "cylinder": [[0, 1], [2]], "box": [[0], [1], [2]]}
"""Axes over which the length of a local point on the surface is at most 1."""


@pytest.mark.parametrize("primitive", EXTENT)
@given(azimuth=st.floats(0, 6.28), height=st.floats(-0.95, 0.95), x=coordinates, y=coordinates, z=coordinates)
def test_a_ray_enters_a_shape_through_its_surface_against_the_normal(primitive, azimuth, height, x, y, z):
    placement = PlacedPrimitive(primitive, (0.3, -0.2, 0.1), (0.5, 0.7, 0.4), turn_deg=25.0, tilt_deg=50.0)
    flat = np.sqrt(1 - height**2)
    origin = 5 * row(flat * np.cos(azimuth), flat * np.sin(azimuth), height)
    inside = placement.axes @ (np.array([x, y, z]) * 0.55 * placement.half_sizes) + placement.center
    direction = (inside - origin).astype(np.float32)
    distance = placement.entry_distances(origin, direction)
    assert 0 < distance[0] < 1
    local = placement.to_local(origin + distance[:, None] * direction)[0]
    lengths = [np.linalg.norm(local[axes]) for axes in EXTENT[primitive]]
    assert max(lengths) == pytest.approx(1, abs=1e-3)
    normal = placement.normals_at(local[None])[0]
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
    assert normal @ direction[0] < 0


def test_a_cylinder_is_hit_on_its_cap_from_above_and_on_its_side_from_the_side():
    cylinder = PlacedPrimitive("cylinder", (1.0, 0.0, 0.0), (0.5, 0.5, 2.0))
    origins = np.vstack([row(1.2, 0.1, 7), row(-3, 0, 1)])
    directions = np.vstack([row(0, 0, -1), row(1, 0, 0)])
    distances = cylinder.entry_distances(origins, directions)
    assert_allclose(distances, [5.0, 3.5], rtol=1e-6)
    normals = cylinder.normals_at(cylinder.to_local(origins + distances[:, None] * directions))
    assert_allclose(normals, [[0, 0, 1], [-1, 0, 0]], atol=1e-6)


def test_a_normal_of_a_squeezed_sphere_is_the_gradient_of_its_equation():
    sizes = np.array([0.5, 0.25, 1.0])
    sphere = PlacedPrimitive("sphere", (0.0, 0.0, 0.0), (0.5, 0.25, 1.0))
    local = np.array([[0.48, 0.6, 0.64]], dtype=np.float32)
    gradient = local[0] * sizes / sizes**2
    assert_allclose(sphere.normals_at(local)[0], gradient / np.linalg.norm(gradient), rtol=1e-5)


def test_a_ray_that_misses_or_looks_away_hits_nothing():
    origins, directions = np.vstack([row(0, 0, 5), row(0, 0, 5)]), np.vstack([row(0, 0, 1), row(1, 0, 0)])
    distances, _ = first_hits(PLACEMENTS, origins, directions)
    assert np.isinf(distances).all()
