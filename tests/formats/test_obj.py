"""OBJ, read back with trimesh."""

import numpy as np

from tests.products.mesh_reading import loaded_mesh
from unmix_plugin.formats.meshes import obj_paths, write_obj

GENERATOR = np.random.default_rng(0)
POSITIONS = GENERATOR.normal(size=(5, 3)).astype(np.float32)
NORMALS = GENERATOR.normal(size=(5, 3)).astype(np.float32)
SRGB = GENERATOR.uniform(size=(5, 3))
FACES = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 0]])
PALETTE = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0], [0.0, 1.0, 0.0]])


def written(folder):
    materials = np.array([1, 0, 1])
    names = ["red clay", "blue/green", "never used"]
    return write_obj(
        folder / "a.mesh", POSITIONS, NORMALS, SRGB, FACES, materials, names, PALETTE, ["about\nit"]
    )


def test_another_reader_gets_the_triangles_their_colours_and_normals(tmp_path):
    assert written(tmp_path) == obj_paths(tmp_path / "a.mesh")
    mesh = loaded_mesh(tmp_path / "a.mesh.obj")
    triangles = {tuple(map(tuple, corners)) for corners in mesh.triangles.astype(np.float32)}
    assert triangles == {tuple(map(tuple, POSITIONS[face])) for face in FACES}
    nearest = [int(np.linalg.norm(POSITIONS - vertex, axis=1).argmin()) for vertex in mesh.vertices]
    np.testing.assert_allclose(mesh.vertex_attributes["color"], SRGB[nearest], atol=1e-8)


def test_numbers_are_exact_for_float32(tmp_path):
    written(tmp_path)
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
    written(tmp_path)
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
