import io
import json
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from tests.factories.ball_model import ALL_ROUND, RADIUS, ball_scene, cameras_around
from tests.factories.cameras import FRAME
from tests.factories.outputs import loaded_mesh
from tests.factories.systems import needs_xatlas
from unmix_plugin.errors import ConfigError
from unmix_plugin.products.mesh import export, textures_of, write_mesh
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Mesh
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.run_views import RunView, world_up
from unmix_plugin.trained.surface import property_names
from unmix_plugin.trained.surface_mesh import TriangleMesh, surface_of

SCENE = ball_scene()
ABUNDANCES = property_names(SCENE.materials.names)


@pytest.fixture(scope="module")
def outside():
    views = tuple(RunView(str(index), camera) for index, camera in enumerate(cameras_around(ALL_ROUND)))
    return surface_of(replace(SCENE, views=views), 48)[0]


@pytest.fixture(scope="module")
def files(outside, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    written = write_mesh(folder, ("ply", "obj", "glb"), outside, SCENE, FRAME, up="z")
    assert [path.name for path in written] == ["mesh.ply", "mesh.obj", "mesh.mtl", "mesh.glb"]
    return {path.suffix: path for path in written}


@pytest.mark.parametrize("kind", [".ply", ".obj", ".glb"])
def test_other_readers_get_the_mesh_in_the_world_of_the_scene(files, outside, kind):
    mesh = loaded_mesh(files[kind])
    assert len(mesh.faces) == len(outside.faces)
    distances = np.linalg.norm(mesh.vertices - FRAME.to_world(np.zeros(3)), axis=1)
    np.testing.assert_allclose(distances, RADIUS / FRAME.scale, atol=0.05 / FRAME.scale)
    assert mesh.volume > 0


def test_gltf_alone_is_in_metres_where_the_scene_has_a_scale_and_y_is_up_in_it(files, outside, tmp_path):
    write_mesh(tmp_path, ("glb", "ply"), outside, replace(SCENE, scale=Scale(0.025, "test")), FRAME)
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
    write_mesh(tmp_path, ("obj", "ply"), outside, SCENE, FRAME)
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
    written = write_mesh(folder, ("obj", "glb"), outside, SCENE, FRAME, "z", textures_of(SCENE, outside, 256))
    pictures = [f"mesh_{name}.png" for name in ("colour", "segmentation", *ABUNDANCES)]
    assert sorted(path.name for path in written) == sorted(["mesh.obj", "mesh.mtl", "mesh.glb", *pictures])
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
    textures = textures_of(SCENE, beside, 64)
    write_mesh(tmp_path, ("ply", "obj"), beside, SCENE, FRAME, textures=textures)
    assert set(PlyData.read(tmp_path / "mesh.ply")["vertex"]["scalar_material"]) == {255}
    assert "usemtl material_3_nothing" in (tmp_path / "mesh.obj").read_text()
    assert (np.asarray(Image.open(io.BytesIO(textures.pictures["segmentation"]))) == 255).all()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (Mesh(smoothing=-0.5), "--smoothing is -0.5"),
        (Mesh(smoothing=9.0), "choose 0 to 8 pixels"),
    ],
)
def test_impossible_settings_are_refused(asked, said):
    with pytest.raises(ConfigError, match=said):
        export(MagicMock(spec=Job), asked)


@needs_xatlas
def test_textures_that_are_too_small_or_of_no_size_are_refused(outside):
    for size, said in ((9, "--texture-size is 9; choose 16 to 8192"), (16, "choose a larger --texture-size")):
        with pytest.raises(ConfigError, match=said):
            textures_of(SCENE, outside, size)
