"""PLY, read back with plyfile and trimesh."""

import numpy as np
import pytest
from plyfile import PlyData

from tests.formats.cubes import full_disk
from tests.products.mesh_reading import loaded_mesh
from unmix_plugin.errors import RunError
from unmix_plugin.formats.meshes import write_ply

GENERATOR = np.random.default_rng(0)
FACES = np.array([[0, 1, 2], [2, 1, 3]])


def vertices(count: int = 4) -> dict[str, np.ndarray]:
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


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    full_disk(monkeypatch, after=100)
    with pytest.raises(RunError, match="No space left"):
        write_ply(tmp_path / "points.ply", vertices(1000))
    assert list(tmp_path.iterdir()) == []
