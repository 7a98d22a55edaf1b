"""PLY, OBJ and GLB, read back with plyfile and trimesh, and against the specification."""

import json
import struct

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from tests.factories.outputs import loaded_mesh
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
    given, path = vertices(count), tmp_path / "deep" / "points.ply"
    assert write_ply(path, given) == path
    read = PlyData.read(path)
    assert (read.text, read.byte_order) == (False, "<")
    assert [prop.name for prop in read["vertex"].properties] == list(given)
    for name, values in given.items():
        found = np.asarray(read["vertex"][name])
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)
    with pytest.raises(KeyError, match="int64"):
        write_ply(tmp_path / "other.ply", {"x": np.zeros(3, dtype=np.int64)})


def test_another_reader_gets_the_triangles(tmp_path):
    given = vertices()
    path = write_ply(tmp_path / "mesh.ply", given, FACES, ["first line", "second\nline"])
    assert PlyData.read(path).comments == ["first line", "second line"]
    mesh = loaded_mesh(path)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.vertices, np.stack([given[axis] for axis in "xyz"], axis=1))
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, 0], given["red"])


@pytest.fixture(scope="module")
def written_obj(tmp_path_factory):
    base, names = tmp_path_factory.mktemp("obj") / "a.mesh", ["red clay", "blue/green", "never used"]
    of_vertices = (POSITIONS, NORMALS, COLOURS)
    files = write_obj(base, *of_vertices, FACES, MATERIALS, names, PALETTE, ["about\nit"])
    assert files == obj_paths(base)
    return files


def test_another_reader_gets_the_triangles_their_colours_and_normals(written_obj):
    mesh = loaded_mesh(written_obj[0])
    triangles = {tuple(map(tuple, corners)) for corners in mesh.triangles.astype(np.float32)}
    assert triangles == {tuple(map(tuple, POSITIONS[face])) for face in FACES}
    nearest = [int(np.linalg.norm(POSITIONS - vertex, axis=1).argmin()) for vertex in mesh.vertices]
    np.testing.assert_allclose(mesh.vertex_attributes["color"], COLOURS[nearest], atol=1e-8)


def test_numbers_are_exact_for_float32_and_each_face_has_its_material_in_its_colour(written_obj):
    lines = written_obj[0].read_text().splitlines()
    rows = {kind: [line.split()[1:] for line in lines if line.startswith(f"{kind} ")] for kind in ("v", "vn")}
    np.testing.assert_array_equal(np.array(rows["v"], dtype=np.float32)[:, :3], POSITIONS)
    np.testing.assert_array_equal(np.array(rows["vn"], dtype=np.float32), NORMALS)
    assert lines[:2] == ["# about it", "mtllib a.mesh.mtl"]
    assert [line for line in lines if line[0] in "uf"] == [
        "usemtl material_0_red_clay",
        "f 3//3 2//2 4//4",
        "usemtl material_1_blue_green",
        "f 1//1 2//2 3//3",
        "f 4//4 5//5 1//1",
    ]
    library = written_obj[1].read_text()
    assert "newmtl material_1_blue_green\nKd 0 0.5 1\n" in library
    assert library.count("newmtl") == 3


def test_the_container_is_as_the_specification_has_it_and_another_reader_gets_its_numbers(tmp_path):
    numbers, extras = {"_MATERIAL": NORMALS[:, 0]}, {"materials": ["oak", "löss"]}
    path = write_glb(tmp_path / "mesh.glb", POSITIONS, NORMALS, COLOURS, FACES, numbers, extras)
    mesh = loaded_mesh(path)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(np.float32(mesh.vertices), POSITIONS)
    np.testing.assert_array_equal(np.ravel(mesh.vertex_attributes["_MATERIAL"]), NORMALS[:, 0])
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    text_length, text_kind = struct.unpack("<I4s", data[12:20])
    content = json.loads(data[20 : 20 + text_length])
    start = 28 + text_length
    binary_length, binary_kind = struct.unpack("<I4s", data[start - 8 : start])
    assert (text_kind, binary_kind, text_length % 4, binary_length % 4) == (b"JSON", b"BIN\0", 0, 0)
    assert start + binary_length == len(data)
    assert content["asset"]["version"] == "2.0"
    assert content["meshes"][0]["extras"] == {**extras, "up": [0, 1, 0]}
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    position, colour = (content["accessors"][attributes[name]] for name in ("POSITION", "COLOR_0"))
    bounds = (POSITIONS.min(axis=0).tolist(), POSITIONS.max(axis=0).tolist())
    assert (position["min"], position["max"]) == bounds
    assert (colour["type"], colour["componentType"], colour["count"]) == ("VEC3", 5126, len(COLOURS))
    start += content["bufferViews"][colour["bufferView"]]["byteOffset"]
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
    from_up = Rotation.from_quat(least_turns(np.eye(3)[2:], ends)).apply([0, 0, 1])
    np.testing.assert_allclose(from_up, ends, atol=1e-6)
