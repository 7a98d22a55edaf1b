import io
import json
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from plyfile import PlyData

from tests.factories.ball_model import (
    ALL_ROUND,
    DENSITY,
    EDGE,
    FROM_ABOVE,
    INNER_RADIUS,
    RADIUS,
    ball_scene,
    seen_surface,
)
from tests.factories.cameras import FRAME
from tests.factories.outputs import loaded_mesh
from tests.factories.systems import needs_xatlas
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.products.mesh import _mesh_paths, _textures, _write_mesh, export
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Mesh
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.run_views import world_up
from unmix_plugin.trained.surface import GridPoints, property_names, sample_field
from unmix_plugin.trained.surface_mesh import (
    TriangleMesh,
    _extract_mesh,
    _filled,
    _surface_density,
    _trim_unseen,
    _without_stray_pieces,
    surface_of,
)

SCENE = ball_scene()
ABUNDANCES = property_names(SCENE.materials.names)
PIXEL = SCENE.pixel_size
THRESHOLD = -float(np.log(0.5)) / PIXEL
GRID = GridPoints.over(SCENE.scene_box.aabb, 48)


@pytest.fixture(scope="module")
def densities():
    return np.stack([sample_field(SCENE, GRID.slice_points(i))[0].numpy() for i in range(GRID.shape[0])])


@pytest.fixture(scope="module")
def whole(densities):
    """Both sides of the hollow ball."""
    return _extract_mesh(densities, GRID, THRESHOLD, 0.0, PIXEL)


@pytest.fixture(scope="module")
def seen_all_round():
    return seen_surface(SCENE, ALL_ROUND, 20_000)


@pytest.fixture(scope="module")
def outside(whole, seen_all_round):
    return _without_stray_pieces(_trim_unseen(whole, seen_all_round))


def radii(mesh):
    return np.linalg.norm(mesh.vertices, axis=1)


def test_marching_finds_the_surfaces_where_they_are(whole):
    depth = EDGE * np.log(DENSITY / THRESHOLD - 1)  # of the threshold, before the spheres
    outer, inner = RADIUS + depth, INNER_RADIUS - depth
    off = np.minimum(np.abs(radii(whole) - outer), np.abs(radii(whole) - inner))
    assert off.max() < 0.6 * GRID.cell
    volume = trimesh.Trimesh(whole.vertices, whole.faces, process=False).volume
    assert volume == pytest.approx(4 / 3 * np.pi * (outer**3 - inner**3), rel=0.02)


def test_insides_that_no_camera_sees_are_trimmed_and_the_rest_stays_whole_and_faces_outwards(outside):
    outwards = outside.vertices / radii(outside)[:, None]
    np.testing.assert_allclose(np.linalg.norm(outside.normals, axis=1), 1, atol=1e-9)
    assert (outside.normals * outwards).sum(axis=1).min() > 0.5
    assert radii(outside).min() > RADIUS - 0.05
    shape = trimesh.Trimesh(outside.vertices, outside.faces, process=False)
    assert shape.area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.12)
    assert shape.is_watertight


def test_what_no_camera_sees_into_is_solid(densities, seen_all_round):
    points = np.stack([GRID.slice_points(index).numpy() for index in range(GRID.shape[0])])
    rendered = np.where(np.linalg.norm(points, axis=-1) < INNER_RADIUS + 0.1, 0, densities)
    rendered[rendered < 1e-3 * THRESHOLD] = 0
    shell = _extract_mesh(rendered, GRID, THRESHOLD, 0.0, PIXEL)
    solid = _extract_mesh(_filled(rendered, GRID, SCENE, seen_all_round), GRID, THRESHOLD, 0.0, PIXEL)
    assert radii(shell).min() < INNER_RADIUS + 0.15
    assert radii(solid).min() > RADIUS - 0.05
    seen_from_outside = _trim_unseen(solid, seen_all_round)
    assert len(seen_from_outside.vertices) == int((radii(shell) > RADIUS - 0.05).sum())
    assert radii(seen_from_outside).max() < RADIUS + 0.05


def test_undersides_that_no_camera_sees_are_trimmed(whole):
    trimmed = _trim_unseen(whole, seen_surface(SCENE, FROM_ABOVE, 20_000))
    assert trimmed.vertices[:, 2].max() > 0.55
    assert trimmed.vertices[:, 2].min() > -0.5
    assert radii(trimmed).min() > RADIUS - 0.05


def ribbon(count, left):
    """Vertices and faces of `count` triangles in a row, each sharing an edge with the next."""
    index = np.arange(count)
    places = np.arange(count + 2)
    vertices = np.stack([left + 0.5 * places, places % 2, np.zeros(count + 2)], axis=1)
    return vertices, np.stack([index, index + 1, index + 2], axis=1)


def test_stray_pieces_go_though_they_touch_the_rest_in_a_point_and_large_ones_stay():
    (large, large_faces), (middle, middle_faces) = ribbon(120, 0.0), ribbon(20, 200.0)
    two, two_faces = ribbon(2, 61.0)
    vertices = np.concatenate([large, middle, two])
    two_faces = two_faces + len(large) + len(middle)
    two_faces[0, 0] = len(large) - 1  # the last vertex of the large piece
    faces = np.concatenate([large_faces, middle_faces + len(large), two_faces])
    kept = _without_stray_pieces(TriangleMesh(vertices, faces))
    assert len(kept.faces) == 120 + 20
    assert len(kept.vertices) == len(large) + len(middle)
    assert len(_without_stray_pieces(TriangleMesh(*ribbon(2, 0.0))).faces) == 2
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert len(_without_stray_pieces(empty).faces) == 0


def test_a_blur_does_not_move_a_flat_wall_and_a_surface_that_reaches_the_box_is_closed_there():
    grid = GridPoints(np.zeros(3, dtype=np.float32), 0.1, (12, 12, 12))
    wall = np.zeros(grid.shape, dtype=np.float32)
    wall[6:] = 1e4
    mesh = _extract_mesh(wall, grid, -np.log(0.5) / PIXEL, 1.5, PIXEL)
    middle = mesh.vertices[(np.abs(mesh.vertices[:, 1:] - 0.55) < 0.15).all(axis=1)]
    front = middle[middle[:, 0] < 0.9]
    np.testing.assert_allclose(front[:, 0], 0.55, atol=0.01)
    mesh = _extract_mesh(np.full(grid.shape, 1e4, dtype=np.float32), grid, 1.0, 0.0, PIXEL)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
    np.testing.assert_allclose(mesh.vertices.max(axis=0), 1.1, atol=0.1)


def test_the_surface_lies_at_the_density_where_rays_end(seen_all_round):
    points = seen_all_round.points()
    threshold = _surface_density(SCENE, points)
    found, _ = SCENE.field.get_density(points.positions)
    assert (found < threshold).float().mean() == pytest.approx(0.07, abs=0.01)
    nowhere = points.select(torch.zeros(len(points), dtype=torch.bool))
    with pytest.raises(RunError, match="no ray of the run's cameras ends"):
        _surface_density(SCENE, nowhere)


@pytest.fixture(scope="module")
def files(outside, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    written = _write_mesh(folder, ("ply", "obj", "glb"), outside, SCENE, FRAME, up="z")
    assert written == _mesh_paths(folder, ("ply", "obj", "glb"), None)
    return {path.suffix: path for path in written}


@pytest.mark.parametrize("kind", [".ply", ".obj", ".glb"])
def test_other_readers_get_the_mesh_in_the_world_of_the_scene(files, outside, kind):
    mesh = loaded_mesh(files[kind])
    assert len(mesh.faces) == len(outside.faces)
    distances = np.linalg.norm(mesh.vertices - FRAME.to_world(np.zeros(3)), axis=1)
    np.testing.assert_allclose(distances, RADIUS / FRAME.scale, atol=0.05 / FRAME.scale)
    assert mesh.volume > 0


def test_gltf_alone_is_in_metres_where_the_scene_has_a_scale_and_y_is_up_in_it(files, outside, tmp_path):
    _write_mesh(tmp_path, ("glb", "ply"), outside, replace(SCENE, scale=Scale(0.025, "test")), FRAME)
    metres, units = loaded_mesh(tmp_path / "mesh.glb"), loaded_mesh(files[".glb"]).vertices
    heights = units @ world_up(SCENE.views, FRAME)
    np.testing.assert_allclose(metres.vertices[:, 1], 0.025 * heights, atol=1e-6)
    lengths = [np.linalg.norm(one, axis=1) for one in (metres.vertices, 0.025 * units)]
    np.testing.assert_allclose(*lengths, atol=1e-6)
    assert metres.volume > 0
    plain, scaled = (PlyData.read(path)["vertex"]["x"] for path in (files[".ply"], tmp_path / "mesh.ply"))
    np.testing.assert_array_equal(plain, scaled)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_an_obj_stands_where_importers_take_y_for_up(outside, tmp_path, monkeypatch, axis):
    up = np.eye(3)["xyz".index(axis)]
    monkeypatch.setattr("unmix_plugin.products.mesh.world_up", lambda *_: up)
    _write_mesh(tmp_path, ("obj", "ply"), outside, SCENE, FRAME)
    ply = PlyData.read(tmp_path / "mesh.ply")["vertex"]
    world = np.stack([ply[one] for one in "xyz"], axis=1)
    lines = [line.split() for line in (tmp_path / "mesh.obj").read_text().splitlines()]
    turned = np.array([line[1:4] for line in lines if line[0] == "v"], dtype=np.float32)
    np.testing.assert_array_equal(turned[:, 1], world @ up.astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(world, axis=1), rtol=1e-6)
    mesh = loaded_mesh(tmp_path / "mesh.obj")
    assert mesh.volume > 0
    outwards = np.array([line[1:4] for line in lines if line[0] == "vn"], dtype=float)
    middle = turned.mean(axis=0)
    assert ((turned - middle) * outwards).sum(axis=1).mean() > 0.9 * RADIUS / FRAME.scale * 0.9
    if axis == "z":  # Blender's import, y up to z up, gives back the world
        np.testing.assert_array_equal(np.stack([turned[:, 0], -turned[:, 2], turned[:, 1]], axis=1), world)
    says = [" ".join(line) for line in lines if line[0] == "#"]
    assert any("turned so that y is up" in one for one in says) is (axis != "y")


def test_ply_and_glb_have_the_same_floats_and_vertices_the_material_of_their_half(files, outside):
    vertices, glb = PlyData.read(files[".ply"])["vertex"], loaded_mesh(files[".glb"])
    world = FRAME.to_world(outside.vertices).astype(np.float32)
    np.testing.assert_array_equal(np.stack([vertices[axis] for axis in "xyz"], axis=1), world)
    np.testing.assert_array_equal(np.float32(glb.vertices), world)
    shares = {f"_{name.upper()}": name for name in ABUNDANCES}
    assert set(glb.vertex_attributes) == {"_MATERIAL", *shares}
    for attribute, name in {"_MATERIAL": "material", **shares}.items():
        np.testing.assert_array_equal(
            np.float32(np.ravel(glb.vertex_attributes[attribute])), vertices[f"scalar_{name}"]
        )
    height = outside.vertices[:, 2]
    assert (vertices["scalar_material"][height > 0.05] == 0).all()
    assert (vertices["scalar_material"][height < -0.05] == 1).all()


@pytest.fixture(scope="module")
def textured(outside, tmp_path_factory):
    folder = tmp_path_factory.mktemp("textured")
    written = _write_mesh(folder, ("obj", "glb"), outside, SCENE, FRAME, "z", _textures(SCENE, outside, 256))
    assert sorted(written) == sorted(_mesh_paths(folder, ("obj", "glb"), SCENE.materials.names))
    return folder


def sampled(picture, uv):
    """Texels of a picture where uv, v upwards, points."""
    pixels = np.asarray(picture)
    rows, columns = ((1 - uv[:, 1]) * len(pixels)).astype(int), (uv[:, 0] * pixels.shape[1]).astype(int)
    return pixels[rows.clip(0, len(pixels) - 1), columns.clip(0, pixels.shape[1] - 1)]


@needs_xatlas
@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textures_show_the_material_of_the_place_that_they_lie_on(textured, files, kind):
    mesh = loaded_mesh(textured / f"mesh.{kind}")
    height = FRAME.to_model(np.asarray(mesh.vertices))[:, 2]
    uv, away = np.asarray(mesh.visual.uv), np.abs(height) > 0.05
    ids = sampled(Image.open(textured / "mesh_segmentation.png"), uv)
    np.testing.assert_array_equal(ids[away], (height < 0)[away])
    shares = sampled(Image.open(textured / f"mesh_{ABUNDANCES[0]}.png"), uv)
    np.testing.assert_array_equal(shares[away], 255 * (height > 0)[away])
    vertices = PlyData.read(files[".ply"])["vertex"]
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1).astype(int)
    expected = [colours[vertices[f"scalar_{ABUNDANCES[index]}"].argmax()] for index in (0, 1)]
    found = sampled(Image.open(textured / "mesh_colour.png").convert("RGB"), uv)[away].astype(int)
    assert np.abs(found - np.where((height > 0)[away, None], *expected)).max() <= 1
    outwards = mesh.vertices - FRAME.to_world(np.zeros(3))
    assert (mesh.vertex_normals * outwards).sum(axis=1).min() > 0


@needs_xatlas
def test_a_textured_glb_has_its_segmentation_and_abundances_as_variants(textured):
    data = (textured / "mesh.glb").read_bytes()
    content = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    names = ["colour", "segmentation", *ABUNDANCES]
    variants = content["extensions"]["KHR_materials_variants"]["variants"]
    assert [one["name"] for one in variants] == [one["name"] for one in content["materials"]] == names
    assert content["extensionsUsed"] == ["KHR_materials_variants", "KHR_materials_unlit"]
    primitive = content["meshes"][0]["primitives"][0]
    assert "COLOR_0" not in primitive["attributes"]
    mappings = primitive["extensions"]["KHR_materials_variants"]["mappings"]
    assert mappings[3] == {"material": 3, "variants": [3]}
    assert "map_Kd mesh_colour.png" in (textured / "mesh.mtl").read_text()


@needs_xatlas
def test_what_shows_nothing_from_above_has_no_material(tmp_path):
    corners = np.array(
        [[0.9, 0.0, 0.0], [0.9, 0.0, 0.1], [0.9, 0.1, 0.0]]
    )  # its front faces away from the ball
    beside = TriangleMesh(corners, np.array([[0, 1, 2]]))
    assert beside.normals[0, 0] < 0
    textures = _textures(SCENE, beside, 64)
    _write_mesh(tmp_path, ("ply", "obj"), beside, SCENE, FRAME, textures=textures)
    assert set(PlyData.read(tmp_path / "mesh.ply")["vertex"]["scalar_material"]) == {255}
    assert "usemtl material_3_nothing" in (tmp_path / "mesh.obj").read_text()
    assert (np.asarray(Image.open(io.BytesIO(textures.pictures["segmentation"]))) == 255).all()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (Mesh(density=0.0), "--density is 0"),
        (Mesh(density=float("nan")), "--density is nan"),
        (Mesh(smoothing=-0.5), "--smoothing is -0.5"),
        (Mesh(smoothing=9.0), "choose 0 to 8 cells"),
    ],
)
def test_impossible_settings_are_refused(asked, said):
    with pytest.raises(ConfigError, match=said):
        export(MagicMock(spec=Job), asked)


@needs_xatlas
def test_surfaces_that_are_none_and_textures_that_are_too_small_or_of_no_size_are_refused(densities, outside):
    for size, said in ((9, "--texture-size is 9; choose 16 to 8192"), (16, "choose a larger --texture-size")):
        with pytest.raises(ConfigError, match=said):
            _textures(SCENE, outside, size)
    with pytest.raises(ConfigError, match=r"the density asked for; choose a lower --density"):
        _extract_mesh(densities, GRID, 1e9, 0.0, PIXEL)
    with pytest.raises(RunError, match="no camera of the run sees it; keep it with --unseen keep"):
        surface_of(replace(SCENE, views=()), 16, THRESHOLD)
