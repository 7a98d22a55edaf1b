"""Meshes from files: what is kept, turned, noted and refused."""

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close

from unmix_plugin.errors import SceneError
from unmix_plugin.neumatex.geometry import read_mesh as reading
from unmix_plugin.neumatex.geometry.mesh import mesh_of
from unmix_plugin.neumatex.geometry.read_mesh import read_mesh


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_formats_agree(tmp_path, suffix):
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=12, minor_sections=8)
    path = tmp_path / f"mesh.{suffix}"
    torus.export(path)
    notes = []
    mesh = read_mesh(path, notes)
    assert notes == []
    corners = torch.as_tensor(np.array(torus.triangles), dtype=torch.float32)
    assert_close(mesh.corners(), corners, atol=1e-6, rtol=0)


def test_scene_graph_is_applied_and_parts_are_joined(tmp_path):
    scene = trimesh.Scene()
    box = trimesh.creation.box()
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((3, 0, 0)))
    scene.add_geometry(box, transform=trimesh.transformations.scale_matrix(2.0))
    scene.export(tmp_path / "mesh.glb")
    mesh = read_mesh(tmp_path / "mesh.glb")
    assert len(mesh.faces) == 24
    assert_close(mesh.vertices.max(dim=0).values, torch.tensor([3.5, 1.0, 1.0]))
    assert_close(mesh.vertices.min(dim=0).values, torch.tensor([-1.0, -1.0, -1.0]))


def test_normals_of_the_file_are_kept(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=1)
    tilted = np.add(sphere.vertices, (0.3, 0, 0))
    normals = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    trimesh.Trimesh(sphere.vertices, sphere.faces, vertex_normals=normals, process=False).export(
        tmp_path / "m.glb", include_normals=True
    )
    mesh = read_mesh(tmp_path / "m.glb")
    assert_close(mesh.normals, torch.tensor(normals, dtype=torch.float32), atol=1e-5, rtol=0)


def test_inward_triangles_are_turned_and_said(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    sphere.invert()
    sphere.export(tmp_path / "mesh.ply", vertex_normal=False)
    notes = []
    mesh = read_mesh(tmp_path / "mesh.ply", notes)
    assert len(notes) == 1
    assert "turned outwards" in notes[0]
    assert_close(mesh.normals, mesh.vertices, atol=0.05, rtol=0)
    a, b, c = mesh.corners().unbind(1)
    assert bool(((torch.linalg.cross(b - a, c - a) * a).sum(-1) > 0).all())


def test_an_open_mesh_is_noted(tmp_path):
    box = trimesh.creation.box()
    trimesh.Trimesh(box.vertices, box.faces[1:]).export(tmp_path / "mesh.ply")
    notes = []
    read_mesh(tmp_path / "mesh.ply", notes)
    assert len(notes) == 1
    assert "open" in notes[0]


def _ply(path, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


def test_bad_meshes_are_refused(tmp_path, monkeypatch):
    line = [[0, 0, 0], [1, 1, 1], [2, 2, 2]]
    with pytest.raises(SceneError, match="none of its 1 triangles has an area"):
        read_mesh(_ply(tmp_path / "line.ply", line, [[0, 1, 2]]))
    with pytest.raises(SceneError, match="position of vertex 1 is not finite"):
        read_mesh(_ply(tmp_path / "nan.ply", [[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    (tmp_path / "text.ply").write_text("no mesh")
    with pytest.raises(SceneError, match=r"can't be read as a mesh|no triangles"):
        read_mesh(tmp_path / "text.ply")
    with pytest.raises(SceneError, match="there is no such mesh file"):
        read_mesh(tmp_path / "missing.glb")
    (tmp_path / "mesh.stl").write_text("solid")
    with pytest.raises(SceneError, match="convert it to one of"):
        read_mesh(tmp_path / "mesh.stl")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(SceneError, match="no triangles"):
        read_mesh(tmp_path / "points.ply")
    monkeypatch.setattr(reading, "MAX_TRIANGLES", 11)
    trimesh.creation.box().export(tmp_path / "box.ply")
    with pytest.raises(SceneError, match="has 12 triangles, at most 11"):
        read_mesh(tmp_path / "box.ply")


def test_model_space_is_centred_with_half_edge_one():
    vertices = torch.tensor([[1.0, 2, 3], [5, 2, 3], [1, 4, 3], [1, 2, 4]])
    mesh = mesh_of(vertices, torch.tensor([[0, 1, 2], [0, 1, 3]]))
    moved = mesh.transformed(*mesh.to_model_space())
    assert_close(moved.vertices.min(dim=0).values, torch.tensor([-1.0, -0.5, -0.25]))
    assert_close(moved.vertices.max(dim=0).values, torch.tensor([1.0, 0.5, 0.25]))
