"""GLB, read back with trimesh, and its structure against the specification."""

import json
import struct

import numpy as np

from tests.products.mesh_reading import loaded_mesh
from unmix_plugin.formats.meshes import write_glb

GENERATOR = np.random.default_rng(0)
COUNT = 7
POSITIONS, NORMALS = (GENERATOR.normal(size=(COUNT, 3)).astype(np.float32) for _ in range(2))
LIGHT = GENERATOR.uniform(size=(COUNT, 3)).astype(np.float32)
FACES = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]])
MATERIAL = GENERATOR.integers(0, 3, COUNT).astype(np.float32)


def written(folder):
    numbers = {"_MATERIAL": MATERIAL}
    return write_glb(
        folder / "mesh.glb", POSITIONS, NORMALS, LIGHT, FACES, numbers, {"materials": ["oak", "löss"]}
    )


def test_another_reader_gets_triangles_and_numbers_exactly(tmp_path):
    mesh = loaded_mesh(written(tmp_path))
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(np.float32(mesh.vertices), POSITIONS)
    np.testing.assert_array_equal(np.ravel(mesh.vertex_attributes["_MATERIAL"]), MATERIAL)


def test_the_container_is_as_the_specification_has_it(tmp_path):
    data = written(tmp_path).read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    text_length, text_kind = struct.unpack("<I4s", data[12:20])
    assert (text_kind, text_length % 4) == (b"JSON", 0)
    content = json.loads(data[20 : 20 + text_length])
    binary_length, binary_kind = struct.unpack("<I4s", data[20 + text_length : 28 + text_length])
    assert (binary_kind, binary_length % 4) == (b"BIN\0", 0)
    assert 28 + text_length + binary_length == len(data)
    assert content["asset"]["version"] == "2.0"
    assert content["meshes"][0]["extras"] == {"materials": ["oak", "löss"]}
    position = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert position["min"] == POSITIONS.min(axis=0).tolist()
    assert position["max"] == POSITIONS.max(axis=0).tolist()
    colour = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (colour["type"], colour["componentType"], colour["count"]) == ("VEC3", 5126, COUNT)
    start = 28 + text_length + content["bufferViews"][colour["bufferView"]]["byteOffset"]
    found = np.frombuffer(data, "<f4", 3 * COUNT, start).reshape(COUNT, 3)
    np.testing.assert_array_equal(found, LIGHT)
    for view in content["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= content["buffers"][0]["byteLength"]
