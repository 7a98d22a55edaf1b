import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from unmix_plugin.products.point_cloud import _is_outlier, _plane_normals, _thinned


def sphere(count: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_lone_points_are_told_from_a_surface():
    lone = np.array([[3.0, 0.0, 0.0], [0.0, -2.0, 0.0]])
    alone = _is_outlier(np.concatenate([sphere(2000), lone]))
    assert alone[-2:].all()
    assert alone[:-2].mean() < 0.01


@pytest.mark.parametrize("count", [0, 1, 8])
def test_few_points_are_company_enough(count):
    assert not _is_outlier(sphere(count)).any()


@given(st.integers(1, 400), st.integers(1, 500))
def test_thinning_gives_distinct_points_and_never_more_than_asked_for(count, wanted):
    positions = sphere(count, seed=count)
    kept = _thinned(positions, wanted)
    assert len(np.unique(kept)) == len(kept)
    assert 1 <= len(kept) <= wanted
    if count <= wanted:
        np.testing.assert_array_equal(kept, np.arange(count))


def test_thinning_covers_evenly_what_was_seen_unevenly():
    dense = sphere(40_000)
    dense = dense[dense[:, 2] > 0.5]
    positions = np.concatenate([sphere(20_000, seed=1), dense])
    kept = positions[_thinned(positions, 1000)]
    assert len(kept) > 900
    gaps, _ = KDTree(kept).query(positions)
    ideal = np.sqrt(4 * np.pi / 1000)
    assert gaps.max() < 1.6 * ideal
    upper = (kept[:, 2] > 0.5).mean()
    assert upper == pytest.approx(0.25, abs=0.03)


def test_points_that_coincide_are_thinned_to_one():
    assert len(_thinned(np.zeros((50, 3)), 10)) == 1


def test_normals_of_a_sphere_are_its_radii_and_face_the_viewer():
    positions = sphere(5000)
    outwards = _plane_normals(positions, positions, np.arange(200))
    inwards = _plane_normals(positions, -positions, np.arange(200))
    np.testing.assert_allclose(np.linalg.norm(outwards, axis=1), 1, atol=1e-9)
    assert (outwards * positions[:200]).sum(axis=1).min() > 0.99
    np.testing.assert_allclose(inwards, -outwards)


def test_where_there_is_no_plane_the_normal_is_the_viewers_direction():
    towards = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]])
    normals = _plane_normals(np.zeros((2, 3)), towards, np.array([0, 1]))
    np.testing.assert_allclose(normals, [[0, 0, 1], [1, 0, 0]])
