"""Meshes from files, and rays against them."""

import json
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close

from tests.factories.surfaces import ball, generator, knot, unit
from tests.factories.systems import needs_posix
from unmix_plugin.errors import SceneError
from unmix_plugin.formats.meshes import write_glb
from unmix_plugin.neumatex.tracing import mesh as reading
from unmix_plugin.neumatex.tracing.mesh import mesh_of, read_mesh, turned_to_viewers
from unmix_plugin.neumatex.tracing.rays import Hits, RayMesh


def closest_twin(mesh, origins, directions):
    """The same as `RayMesh.closest` in plain PyTorch: every ray against every triangle, in double precision.

    Source: Moeller and Trumbore 1997, Fast, Minimum Storage Ray/Triangle Intersection.
    """
    a, b, c = mesh.corners().double().unbind(dim=1)
    o, d = origins.double()[:, None], directions.double()[:, None]
    across = torch.linalg.cross(d, (c - a)[None])
    determinants = ((b - a) * across).sum(dim=-1)
    inverse = torch.where(determinants == 0, torch.inf, 1 / determinants)
    from_a = o - a
    second = (from_a * across).sum(dim=-1) * inverse
    along = torch.linalg.cross(from_a, (b - a).expand_as(from_a))
    third = (d * along).sum(dim=-1) * inverse
    distances = ((c - a) * along).sum(dim=-1) * inverse
    inside = (second >= 0) & (third >= 0) & (second + third <= 1) & (distances > 0) & (distances < 1e30)
    distances, triangles = torch.where(inside, distances, 1e30).min(dim=1)
    found = distances < 1e30
    second, third = (values.gather(1, triangles[:, None])[:, 0] for values in (second, third))
    barycentric = torch.stack([1 - second - third, second], dim=-1) * found[:, None]
    return Hits(found, torch.where(found, triangles, -1), barycentric.float(), distances.float())


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
@pytest.mark.parametrize("first", [0, 1])
def test_formats_agree_and_an_open_mesh_is_noted(tmp_path, suffix, first):
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=12, minor_sections=8)
    torus.update_faces(np.arange(len(torus.faces)) >= first)
    torus.export(tmp_path / f"mesh.{suffix}")
    notes = []
    mesh = read_mesh(tmp_path / f"mesh.{suffix}", notes)
    assert ["is open" in note for note in notes] == [True] * first
    corners = torch.as_tensor(np.array(torus.triangles))
    assert_close(mesh.corners(), corners, atol=1e-6, rtol=0)


def obj_of(path, solid, suffix_of, *more):
    """A file of a solid whose corners are named once, each with a suffix by the number of its face."""
    lines = [f"v {x} {y} {z}" for x, y, z in solid.vertices] + ["vt 0 0", "vt 1 0", *more]
    for index, face in enumerate(solid.faces):
        lines.append("f " + " ".join(f"{corner + 1}{suffix_of(index)}" for corner in face))
    path.write_text("\n".join(lines) + "\n")
    return read_mesh(path)


@pytest.mark.parametrize("texture", ["", "1"])
def test_corners_of_an_obj_have_their_own_normals(tmp_path, texture):
    box = trimesh.creation.box()
    normals = [f"vn {x} {y} {z}" for x, y, z in box.face_normals]
    mesh = obj_of(tmp_path / "box.obj", box, lambda index: f"/{texture}/{index + 1}", *normals)
    expected = torch.from_numpy(np.array(box.face_normals)).float()[:, None].expand(12, 3, 3)
    assert_close(mesh.normals[mesh.faces.long()], expected)
    assert_close(mesh.corners(), torch.from_numpy(np.array(box.triangles)))


def test_without_normals_an_obj_is_smooth_at_seams_of_texture(tmp_path):
    solid = trimesh.creation.icosphere(subdivisions=2)
    mesh = obj_of(tmp_path / "ball.obj", solid, lambda index: f"/{index % 2 + 1}")
    assert_close(mesh.normals, unit(mesh.vertices).float(), atol=0.03, rtol=0)


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_a_mesh_far_from_the_origin_keeps_its_shape(tmp_path, suffix):
    near = trimesh.creation.icosphere(subdivisions=3)
    move = trimesh.transformations.translation_matrix((5e5, 5e6, 100.0))
    if suffix == "glb":
        scene = trimesh.Scene()
        scene.add_geometry(near, transform=move)
        scene.export(tmp_path / "mesh.glb")
    else:
        lines = [" ".join(map(str, vertex)) for vertex in near.vertices + move[:3, 3]]
        faces = np.array(near.faces) + (suffix == "obj")
        start, corner, face = ("", "v ", "f ") if suffix == "obj" else (PLY, "", "3 ")
        lines = [corner + line for line in lines] + [face + " ".join(map(str, one)) for one in faces]
        (tmp_path / f"mesh.{suffix}").write_text(start + "\n".join(lines) + "\n")
    mesh = read_mesh(tmp_path / f"mesh.{suffix}")
    model = mesh.transformed(*mesh.to_model_space())
    assert model.vertices.dtype == torch.float32
    assert_close(model.corners(), torch.from_numpy(np.array(near.triangles)).float(), atol=1e-6, rtol=0)
    assert_close(model.normals, unit(model.vertices), atol=0.02, rtol=0)


PLY = """ply
format ascii 1.0
element vertex 642
property double x
property double y
property double z
element face 1280
property list uchar int vertex_indices
end_header
"""


def test_scene_graph_is_applied_and_parts_are_joined(tmp_path):
    scene, box = trimesh.Scene(), trimesh.creation.box()
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((3, 0, 0)))
    scene.add_geometry(box, transform=trimesh.transformations.scale_matrix(2.0))
    scene.export(tmp_path / "mesh.glb")
    mesh = read_mesh(tmp_path / "mesh.glb")
    assert len(mesh.faces) == 24
    extents = torch.stack(mesh.vertices.aminmax(dim=0))
    assert_close(extents, torch.tensor([[-1.0, -1.0, -1.0], [3.5, 1.0, 1.0]]).double())


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.2, 0.1, 0.97), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("extras", [{}, {"metres_per_unit": 0.05}, {"offset": [5.0, -3.0, 7.0]}])
def test_our_own_gltf_comes_back_as_it_was_in_the_world(tmp_path, up, extras):
    box = trimesh.creation.box()
    world, normals = (np.array(a, dtype=np.float32) for a in (box.vertices + 2.0, box.vertex_normals))
    stored = world - np.array(extras.get("offset", (0, 0, 0)), dtype=np.float32)
    turned = np.array(up) / np.linalg.norm(up)
    faces = np.array(box.faces)
    write_glb(tmp_path / "mesh.glb", stored, normals, np.ones_like(world), faces, {}, extras, turned)
    mesh = read_mesh(tmp_path / "mesh.glb")
    assert_close(mesh.vertices.float(), torch.from_numpy(world))
    assert_close(mesh.normals, torch.from_numpy(normals))


@pytest.mark.parametrize("has_normals", [False, True])
def test_each_piece_is_turned_so_that_its_front_is_seen(tmp_path, has_normals):
    inward, outward = (trimesh.creation.icosphere(subdivisions=2) for _ in range(2))
    outside = np.concatenate([inward.vertices, inward.vertices])
    inward.invert()
    inward.update_faces(np.arange(len(inward.faces)) > 0)  # it may be open
    outward.apply_translation((5, 0, 0))
    both = trimesh.util.concatenate([inward, outward])
    assert isinstance(both, trimesh.Trimesh)
    both.export(tmp_path / "mesh.ply", vertex_normal=has_normals)
    read = read_mesh(tmp_path / "mesh.ply")
    seen = torch.zeros(len(read.faces))
    seen[10], seen[-10], seen[-11] = -1.0, -0.1, 0.3
    mesh, count = turned_to_viewers(read, seen)
    assert count == len(inward.faces)
    normals = torch.from_numpy(outside).float()
    assert_close(mesh.normals, normals, atol=0.05, rtol=0)
    a, b, c = mesh.corners().unbind(1)
    assert bool(((torch.linalg.cross(b - a, c - a) * normals[mesh.faces[:, 0].long()]).sum(-1) > 0).all())
    again, none = turned_to_viewers(mesh, torch.ones(len(mesh.faces)))
    assert none == 0
    assert torch.equal(again.normals, mesh.normals)


def test_a_vertex_of_no_triangle_changes_nothing_however_far_it_is(tmp_path):
    box, notes = trimesh.creation.box(), []
    vertices = np.vstack([box.vertices, [[np.nan, 1e30, 0]]])
    trimesh.Trimesh(vertices, box.faces, process=False).export(tmp_path / "box.ply")
    read = read_mesh(tmp_path / "box.ply", notes)
    assert notes == []
    assert_close(read.vertices.amax(dim=0).double(), torch.full((3,), 0.5, dtype=torch.float64))


@needs_posix
def test_no_file_outside_the_folder_is_read_for_a_mesh_and_no_pipe(tmp_path):
    exported: Any = trimesh.creation.box().export(file_type="gltf")
    folder = tmp_path / "mesh"
    folder.mkdir()
    for name, data in exported.items():
        (folder / name).write_bytes(data)
    assert len(read_mesh(folder / "model.gltf").faces) == 12
    buffer = next(folder.glob("*0.bin"))
    buffer.rename(tmp_path / buffer.name)
    text = (folder / "model.gltf").read_text()
    os.mkfifo(buffer)
    for named in (buffer.name, f"../{buffer.name}", str(tmp_path / buffer.name)):
        (folder / "model.gltf").write_text(text.replace(buffer.name, named))
        with pytest.raises(SceneError, match="there is no file"):
            read_mesh(folder / "model.gltf")


def test_bad_meshes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MAX_TRIANGLES", 11)
    for name, vertices in (("line", [[1, 1, 1], [2, 2, 2]]), ("nan", [[np.nan, 0, 0], [0, 1, 0]])):
        corners = [[0, 0, 0], *vertices]
        trimesh.Trimesh(corners, [[0, 1, 2]], process=False).export(tmp_path / f"{name}.ply")
    (tmp_path / "text.ply").write_text("no mesh")
    (tmp_path / "mesh.stl").write_text("solid")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    trimesh.creation.box().export(tmp_path / "box.ply")
    for name, said in {
        "line.ply": "none of its 1 triangles has an area",
        "nan.ply": "position of vertex 1 is not finite",
        "text.ply": r"can't be read as a mesh|no triangles",
        "missing.glb": "there is no such mesh file",
        "mesh.stl": "convert it to one of",
        "points.ply": "no triangles",
        "box.ply": "has 12 triangles, at most 11",
    }.items():
        with pytest.raises(SceneError, match=said):
            read_mesh(tmp_path / name)


def _add_fan(content):
    content["meshes"][0]["primitives"].append({**content["meshes"][0]["primitives"][0], "mode": 6})


LEFT_OUT: dict[str, Callable[[dict[str, Any]], object]] = {
    "normalized whole numbers": lambda gltf: gltf["accessors"][1].update(normalized=True, componentType=5121),
    "sparse accessors": lambda gltf: gltf["accessors"][1].update(sparse={"count": 1}),
    "triangle fans": _add_fan,
    "KHR_draco_mesh_compression": lambda gltf: gltf.update(extensionsRequired=["KHR_draco_mesh_compression"]),
    "EXT_mesh_gpu_instancing": lambda gltf: gltf["nodes"][0].update(
        extensions={"EXT_mesh_gpu_instancing": {"attributes": {}}}
    ),
    "skins": lambda gltf: gltf["nodes"][0].update(skin=0),
    "morph targets": lambda gltf: gltf["meshes"][0].update(weights=[1.0]),
    "several parents": lambda gltf: gltf["nodes"].extend([{"children": [0]}, {"children": [0]}]),
    "last row 0, 0, 0, 1": lambda gltf: gltf["nodes"][0].update(
        matrix=[1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    ),
}
"""What a mesh would be read without, and what adds it to a glTF of a box."""


@pytest.mark.parametrize("what", LEFT_OUT)
def test_gltf_that_would_be_read_in_part_is_refused(tmp_path, what):
    exported: Any = trimesh.creation.box().export(file_type="gltf")
    for name, data in exported.items():
        (tmp_path / name).write_bytes(data)
    content = json.loads(exported["model.gltf"])
    assert content["accessors"][1]["type"] == "VEC3"
    LEFT_OUT[what](content)
    (tmp_path / "model.gltf").write_text(json.dumps(content))
    with pytest.raises(SceneError, match=what):
        read_mesh(tmp_path / "model.gltf")


def test_a_ply_in_text_that_lacks_its_last_line_is_refused(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply", encoding="ascii")
    lines = (tmp_path / "box.ply").read_text().strip().splitlines()
    assert len(read_mesh(tmp_path / "box.ply").faces) == 12
    (tmp_path / "box.ply").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(SceneError, match="cut short: has 11 of 12 elements 'face'"):
        read_mesh(tmp_path / "box.ply")


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1/1 2/1 0/1", "f 1 2 0"])
def test_an_obj_whose_corners_count_from_0_is_refused(tmp_path, face):
    corners = "v 10 0 0\nv 0 10 0\nv 0 0 10\nvt 0 0\n"
    (tmp_path / "mesh.obj").write_text(f"{corners}f 1 2 3\n")
    assert len(read_mesh(tmp_path / "mesh.obj").faces) == 1
    (tmp_path / "mesh.obj").write_text(f"{corners}f 1 2 3\n{face}\n")
    with pytest.raises(SceneError, match="names vertex 0"):
        read_mesh(tmp_path / "mesh.obj")


def test_an_obj_that_would_lose_its_first_vertex_to_a_byte_order_mark_is_refused(tmp_path):
    faces = "v 10 0 0\nv 0 10 0\nv 0 0 10\nv 9 9 9\nf 1 2 3\nf 2 3 4\n"
    (tmp_path / "mesh.obj").write_text(f"\ufeff# by hand\n{faces}", encoding="utf-8")
    assert len(read_mesh(tmp_path / "mesh.obj").vertices) == 4
    (tmp_path / "mesh.obj").write_text(f"\ufeff{faces}", encoding="utf-8")
    with pytest.raises(SceneError, match="byte order mark"):
        read_mesh(tmp_path / "mesh.obj")


def test_model_space_is_centred_with_half_edge_one():
    vertices = torch.tensor([[1.0, 2, 3], [5, 2, 3], [1, 4, 3], [1, 2, 4]])
    mesh = mesh_of(vertices, torch.tensor([[0, 1, 2], [0, 1, 3]]))
    extents = torch.stack(mesh.transformed(*mesh.to_model_space()).vertices.aminmax(dim=0))
    assert_close(extents, torch.tensor([[-1.0, -0.5, -0.25], [1.0, 0.5, 0.25]]))


DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def _rays(count, seed=0):
    g = generator(seed)
    origins = 1.5 * torch.randn(count, 3, generator=g)
    return origins, unit(torch.randn(count, 3, generator=g) - origins)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("count", [0, 1, 2000])
def test_closest_hits_are_those_of_the_twin(device, count):
    mesh, (origins, directions) = knot(), _rays(count)
    expected = closest_twin(mesh, origins, directions)
    rays = RayMesh(mesh, device), origins.to(device), directions.to(device)
    hits = RayMesh.closest(*rays)
    assert torch.equal(RayMesh.blocked(*rays), hits.found)
    assert torch.equal(hits.found.cpu(), expected.found)
    assert torch.equal(hits.triangles.cpu(), expected.triangles)
    assert_close(hits.distances.cpu(), expected.distances, atol=2e-6, rtol=1e-6)
    assert_close(hits.barycentric.cpu(), expected.barycentric, atol=2e-5, rtol=0)
    assert count < 2000 or 0.2 < hits.found.float().mean() < 0.8


def test_points_lie_on_the_surface_and_face_the_viewer():
    rays = RayMesh(ball())
    origins, directions = _rays(500, seed=2)
    distances = rays.closest(origins, directions).distances
    found, points = rays.seen(origins, directions)
    origins, directions = origins[found], directions[found]
    assert_close(points.positions, origins + distances[found, None] * directions, atol=2e-5, rtol=0)
    assert torch.equal(points.to_eye, -directions)
    assert bool(((points.normals * directions).sum(-1) < 0).all())
    assert bool(((points.geometric_normals * directions).sum(-1) <= 0).all())
    outside = origins.norm(dim=-1) > 1
    assert_close(points.normals[outside], unit(points.positions[outside]), atol=0.05, rtol=0)
    inside = origins.norm(dim=-1) < 0.9
    assert bool(inside.any())
    assert_close(points.normals[inside], -unit(points.positions[inside]), atol=0.02, rtol=0)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_rays_leave_a_convex_surface_without_meeting_it(scale):
    mesh = ball().transformed(scale, torch.zeros(3))
    rays, (origins, directions) = RayMesh(mesh), _rays(4000, seed=3)
    _, points = rays.seen(scale * 2 * unit(origins), directions)
    # Nearly along the surface, where rounding would hurt first.
    tangent = unit(torch.linalg.cross(points.to_eye, points.geometric_normals))
    assert not bool(rays.blocked(points.positions, unit(tangent + 0.01 * points.geometric_normals)).any())
    assert bool(rays.blocked(points.positions, -points.geometric_normals).all())
