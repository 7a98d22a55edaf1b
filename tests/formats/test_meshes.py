"""PLY, OBJ and GLB, read back with plyfile and trimesh, and against the specification."""

import json
import struct

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from tests.products.mesh_reading import loaded_mesh
from unmix_plugin.formats.meshes import least_turns, obj_paths, write_glb, write_obj, write_ply

GENERATOR = np.random.default_rng(0)
POSITIONS, NORMALS = (GENERATOR.normal(size=(5, 3)).astype(np.float32) for _ in range(2))
COLOURS = GENERATOR.uniform(size=(5, 3)).astype(np.float32)
FACES = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 0]])
MATERIALS = np.array([1, 0, 1])
PALETTE = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0], [0.0, 1.0, 0.0]])


def vertices(count: int = 5) -> dict[str, np.ndarray]:
    return {
        **{name: GENERATOR.normal(size=count).astype(np.float32) for name in ("x", "y", "z")},
        "far": GENERATOR.normal(size=count),
        **{name: GENERATOR.integers(0, 256, count).astype(np.uint8) for name in ("red", "green", "blue")},
        "number": GENERATOR.integers(-9, 9, count).astype(np.int32),
    }


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_another_reader_gets_every_property_of_every_point_exactly(tmp_path, count):
    given = vertices(count)
    assert write_ply(tmp_path / "deep" / "points.ply", given) == tmp_path / "deep" / "points.ply"
    read = PlyData.read(tmp_path / "deep" / "points.ply")
    assert (read.text, read.byte_order) == (False, "<")
    assert [prop.name for prop in read["vertex"].properties] == list(given)
    for name, values in given.items():
        found = np.asarray(read["vertex"][name])
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


def test_another_reader_gets_the_triangles(tmp_path):
    given = vertices()
    path = write_ply(tmp_path / "mesh.ply", given, FACES, ["first line", "second\nline"])
    read = PlyData.read(path)
    assert read.comments == ["first line", "second line"]
    np.testing.assert_array_equal(np.stack(list(read["face"]["vertex_indices"])), FACES)
    mesh = loaded_mesh(path)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.vertices, np.stack([given[axis] for axis in "xyz"], axis=1))
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, 0], given["red"])


def test_a_property_that_the_format_has_no_type_for_is_refused(tmp_path):
    with pytest.raises(KeyError, match="int64"):
        write_ply(tmp_path / "points.ply", {"x": np.zeros(3, dtype=np.int64)})
    assert list(tmp_path.iterdir()) == []


def written_obj(folder):
    names = ["red clay", "blue/green", "never used"]
    return write_obj(
        folder / "a.mesh", POSITIONS, NORMALS, COLOURS, FACES, MATERIALS, names, PALETTE, ["about\nit"]
    )


def test_another_reader_gets_the_triangles_their_colours_and_normals(tmp_path):
    assert written_obj(tmp_path) == obj_paths(tmp_path / "a.mesh")
    mesh = loaded_mesh(tmp_path / "a.mesh.obj")
    triangles = {tuple(map(tuple, corners)) for corners in mesh.triangles.astype(np.float32)}
    assert triangles == {tuple(map(tuple, POSITIONS[face])) for face in FACES}
    nearest = [int(np.linalg.norm(POSITIONS - vertex, axis=1).argmin()) for vertex in mesh.vertices]
    np.testing.assert_allclose(mesh.vertex_attributes["color"], COLOURS[nearest], atol=1e-8)


def test_numbers_are_exact_for_float32(tmp_path):
    written_obj(tmp_path)
    lines = (tmp_path / "a.mesh.obj").read_text().splitlines()
    rows = {
        kind: [line.split()[1:] for line in lines if line.startswith(f"{kind} ")] for kind in ("v", "vn", "f")
    }
    np.testing.assert_array_equal(np.array(rows["v"], dtype=np.float32)[:, :3], POSITIONS)
    np.testing.assert_array_equal(np.array(rows["vn"], dtype=np.float32), NORMALS)
    corners = [[tuple(map(int, corner.split("//"))) for corner in row] for row in rows["f"]]
    assert all(position == normal for row in corners for position, normal in row)
    assert lines[0] == "# about it"


def test_each_face_has_the_material_it_was_given_in_its_colour(tmp_path):
    written_obj(tmp_path)
    current, found = "", {}
    for line in (tmp_path / "a.mesh.obj").read_text().splitlines():
        if line.startswith("usemtl "):
            current = line.split()[1]
        elif line.startswith("f "):
            found[tuple(int(corner.split("//")[0]) - 1 for corner in line.split()[1:])] = current
    assert found == {
        (0, 1, 2): "material_1_blue_green",
        (2, 1, 3): "material_0_red_clay",
        (3, 4, 0): "material_1_blue_green",
    }
    library = (tmp_path / "a.mesh.mtl").read_text()
    assert "newmtl material_1_blue_green\nKd 0 0.5 1\n" in library
    assert library.count("newmtl") == 3
    assert "mtllib a.mesh.mtl" in (tmp_path / "a.mesh.obj").read_text()


def written_glb(folder):
    numbers = {"_MATERIAL": NORMALS[:, 0]}
    return write_glb(
        folder / "mesh.glb", POSITIONS, NORMALS, COLOURS, FACES, numbers, {"materials": ["oak", "löss"]}
    )


def test_the_container_is_as_the_specification_has_it_and_another_reader_gets_its_numbers(tmp_path):
    path = written_glb(tmp_path)
    mesh = loaded_mesh(path)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(np.float32(mesh.vertices), POSITIONS)
    np.testing.assert_array_equal(np.ravel(mesh.vertex_attributes["_MATERIAL"]), NORMALS[:, 0])
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    text_length, text_kind = struct.unpack("<I4s", data[12:20])
    assert (text_kind, text_length % 4) == (b"JSON", 0)
    content = json.loads(data[20 : 20 + text_length])
    binary_length, binary_kind = struct.unpack("<I4s", data[20 + text_length : 28 + text_length])
    assert (binary_kind, binary_length % 4) == (b"BIN\0", 0)
    assert 28 + text_length + binary_length == len(data)
    assert content["asset"]["version"] == "2.0"
    assert content["meshes"][0]["extras"] == {"materials": ["oak", "löss"], "up": [0, 1, 0]}
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    position, colour = (content["accessors"][attributes[name]] for name in ("POSITION", "COLOR_0"))
    assert (position["min"], position["max"]) == (
        POSITIONS.min(axis=0).tolist(),
        POSITIONS.max(axis=0).tolist(),
    )
    assert (colour["type"], colour["componentType"], colour["count"]) == ("VEC3", 5126, len(COLOURS))
    start = 28 + text_length + content["bufferViews"][colour["bufferView"]]["byteOffset"]
    found = np.frombuffer(data, "<f4", COLOURS.size, start).reshape(-1, 3)
    np.testing.assert_array_equal(found, COLOURS)
    for view in content["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= content["buffers"][0]["byteLength"]


def test_least_turns_take_one_direction_to_another_about_what_is_square_to_both():
    starts = NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)
    ends = np.concatenate([[starts[0], -starts[1]], np.roll(starts, 1, axis=0)[2:]])
    turns = Rotation.from_quat(least_turns(starts, ends))
    np.testing.assert_allclose(turns.apply(starts), ends, atol=1e-6)
    angles = np.arccos(np.clip((starts * ends).sum(axis=1), -1, 1))
    np.testing.assert_allclose(turns.magnitude(), angles, atol=1e-3)
    np.testing.assert_allclose(
        Rotation.from_quat(least_turns(np.eye(3)[2:], ends)).apply([0, 0, 1]), ends, atol=1e-6
    )
