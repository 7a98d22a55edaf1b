"""Meshes of fewer triangles: closed ones stay closed, shapes stay where they are, boundaries too."""

import numpy as np
import trimesh

from unmix_plugin.trained.decimation import decimated
from unmix_plugin.trained.surface_mesh import TriangleMesh


def _mesh(found: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(np.array(found.vertices, dtype=np.float64), np.array(found.faces, dtype=np.int64))


def test_a_closed_mesh_stays_closed_and_keeps_its_volume():
    ball = trimesh.creation.icosphere(subdivisions=4)
    found = decimated(_mesh(ball), 600)
    result = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert len(found.faces) == 600
    assert result.is_watertight
    assert result.is_winding_consistent
    assert abs(result.volume / ball.volume - 1) < 0.01
    assert abs(np.linalg.norm(found.vertices, axis=1) - 1).max() < 0.03


def test_planes_are_merged_before_edges_are_rounded():
    box = trimesh.creation.box().subdivide().subdivide().subdivide()
    found = decimated(_mesh(box), 40)
    corners = np.abs(trimesh.creation.box().vertices[:, None] - found.vertices).max(axis=2).min(axis=1)
    assert len(found.faces) <= 40
    assert corners.max() < 0.03


def test_an_open_mesh_keeps_its_boundary():
    ball = trimesh.creation.icosphere(subdivisions=4)
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0])
    half.remove_unreferenced_vertices()
    found = decimated(_mesh(half), 300)
    assert len(found.faces) <= 300
    assert abs(found.vertices[:, 2].min() - half.vertices[:, 2].min()) < 0.02


def test_what_has_few_triangles_stays_as_it_is():
    box = _mesh(trimesh.creation.box())
    found = decimated(box, 12)
    assert np.array_equal(np.sort(found.vertices, axis=0), np.sort(box.vertices, axis=0))
    assert len(decimated(box, 1).faces) >= 4
