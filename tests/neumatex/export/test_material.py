"""The material as files: textures, glTF, atlas and texels."""

import json

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image

from tests.factories.outputs import loaded_mesh
from tests.factories.surfaces import LAYERED, PBR, TURN, ball, eye_directions, generator, knot
from tests.factories.systems import needs_xatlas
from unmix_plugin.errors import ConfigError
from unmix_plugin.neumatex.export.material import material_paths, write_material
from unmix_plugin.neumatex.export.pbr_fit import fit_pbr
from unmix_plugin.neumatex.export.product import MaterialProduct
from unmix_plugin.neumatex.tracing.families import LayeredFamily, PbrFamily
from unmix_plugin.neumatex.tracing.mesh import read_mesh
from unmix_plugin.products.atlas import Atlas, texels_of, unwrap
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.colour.conversion import srgb_to_linear

FRAME = Normalisation(TURN, np.array([2.0, 0.0, -1.0]), 0.5)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("material")
    paths, error = write_material(folder, knot(), PBR, FRAME, 256)
    assert error == 0
    assert sorted(paths) == sorted(material_paths(folder, PBR.family))
    assert sorted(paths) == sorted(path for path in folder.rglob("[!.]*") if path.is_file())
    return folder


def sampled(texture, uv):
    """Colours of a texture at glTF coordinates, from the nearest texel."""
    height, width = texture.shape[:2]
    columns, rows = (uv[:, 0] * width).astype(int), (uv[:, 1] * height).astype(int)
    return texture[rows.clip(0, height - 1), columns.clip(0, width - 1)]


def channels_of(path):
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def exr(path):
    return np.stack([channels_of(path)[name] for name in "RGB"], axis=-1)


def png(path):
    return np.asarray(Image.open(path), dtype=np.float32) / 255


@needs_xatlas
def test_the_gltf_shows_the_material_where_the_surface_has_it(written):
    loaded = loaded_mesh(written / "material.glb")
    model = FRAME.to_model(np.asarray(loaded.vertices, dtype=np.float64))
    truth = PBR.parameters(torch.from_numpy(model).float()).numpy()
    uv = np.asarray(loaded.visual.uv) * [1, -1] + [0, 1]  # trimesh has v upwards
    pbr = loaded.visual.material
    base = np.asarray(pbr.baseColorTexture.convert("RGB"), dtype=np.float32) / 255
    linear = srgb_to_linear(torch.from_numpy(sampled(base, uv))).numpy()
    assert np.abs(linear - truth[:, :3]).mean() < 0.012
    packed = np.asarray(pbr.metallicRoughnessTexture, dtype=np.float32) / 255
    assert np.abs(sampled(packed, uv)[:, 1:3] - truth[:, 3:5]).mean() < 0.012
    assert (pbr.metallicFactor, pbr.roughnessFactor) == (1, 1)


@needs_xatlas
def test_the_gltf_is_the_mesh_in_the_world_in_metres_where_the_scale_is_known(written, tmp_path):
    loaded, mesh = loaded_mesh(written / "material.glb"), knot()
    assert len(loaded.faces) == len(mesh.faces)
    corners = np.asarray(loaded.vertices)[loaded.faces]
    world = FRAME.to_world(mesh.vertices.double().numpy())
    np.testing.assert_allclose(corners, world[mesh.faces.numpy()], atol=1e-5)
    outward = np.cross(*np.diff(corners, axis=1).swapaxes(0, 1))
    normals = np.asarray(loaded.vertex_normals)[loaded.faces].mean(axis=1)
    assert ((normals * outward).sum(axis=1) > 0).all()
    write_material(tmp_path, mesh, PBR, FRAME, 256, metres_per_unit=0.001)
    metres = loaded_mesh(tmp_path / "material.glb").vertices
    np.testing.assert_allclose(metres, 0.001 * np.asarray(loaded.vertices), atol=1e-7)


@needs_xatlas
def test_what_is_up_in_the_world_is_y_in_the_gltf_and_read_back_as_it_was(tmp_path):
    mesh = knot()
    write_material(tmp_path, mesh, PBR, FRAME, 256, up=np.array([0.0, 0.0, 1.0]))
    world = FRAME.to_world(mesh.vertices.double().numpy())[mesh.faces.numpy()]
    loaded = loaded_mesh(tmp_path / "material.glb")
    corners = np.asarray(loaded.vertices)[loaded.faces]
    turned = np.stack([world[..., 0], world[..., 2], -world[..., 1]], axis=-1)
    np.testing.assert_allclose(corners, turned, atol=1e-5)
    back = read_mesh(tmp_path / "material.glb").corners().numpy()
    np.testing.assert_allclose(back, world, atol=1e-5)


@needs_xatlas
def test_far_from_the_origin_the_gltf_keeps_positions_to_a_millionth_in_units_of_any_size(tmp_path):
    mesh, frame = knot(), Normalisation(np.eye(3), np.array([3.37, 5.21, 0.0]), 1000.0)  # of 2 mm, in metres
    write_material(tmp_path, mesh, PBR, frame, 256)
    loaded, world = loaded_mesh(tmp_path / "material.glb"), frame.to_world(mesh.vertices.double().numpy())
    found = np.asarray(loaded.vertices, np.float64)[loaded.faces] + loaded.metadata["offset"]
    assert np.abs(found - world[mesh.faces.numpy()]).max() < 1e-6 * np.ptp(world, axis=0).max()


@needs_xatlas
def test_pictures_are_srgb_numbers_linear_and_both_are_what_the_report_says(written):
    numbers, picture = exr(written / "base_colour.exr"), png(written / "base_colour.png")
    assert numbers.shape == picture.shape == (256, 256, 3)
    decoded = srgb_to_linear(torch.from_numpy(picture)).numpy()
    np.testing.assert_allclose(decoded, numbers, atol=0.006)
    rough = exr(written / "gltf_metallic_roughness.exr")
    packed = png(written / "gltf_metallic_roughness.png")
    np.testing.assert_allclose(packed, rough, atol=0.5 / 255 + 1e-6)
    report = json.loads((written / "material.json").read_text())
    channels = channels_of(written / "parameters.exr")
    assert [name[3:] for name in sorted(channels)] == report["parameters"]
    np.testing.assert_array_equal(channels["03 roughness"], rough[..., 1])  # in full precision
    assert report["texture_size"] == 256
    assert 0.4 < report["texels_in_charts"] / 256**2 < 0.9
    for name, texture in report["textures"].items():
        assert (written / f"{name}.png").is_file()
        assert len(texture["channels"]) == 3


def fit_error(parameters, pbr):
    """Mean relative error of reflected light of materials, from independent directions."""
    wi, wo = (eye_directions(len(pbr), seed, lowest=0.0) for seed in (3, 4))
    truth = LayeredFamily().evaluate(parameters, wi, wo) * wi[:, 2:]
    found = PbrFamily().evaluate(pbr, wi, wo) * wi[:, 2:]
    return float((truth.log1p() - found.log1p()).abs().mean() / truth.log1p().mean())


def test_layered_materials_get_a_gltf_material_much_like_them_the_same_each_time():
    parameters = LAYERED.parameters(ball().vertices)
    fitted, error = fit_pbr(LayeredFamily(), parameters, generator(), num_materials=64)
    assert 0 <= fitted.min() <= fitted.max() <= 1
    plain = torch.cat([parameters[:, :3], parameters[:, [4, 3]]], dim=1)  # layers left out
    assert 0.01 < error < 0.2
    assert fit_error(parameters, fitted) < 0.7 * fit_error(parameters, plain)
    first, again = (fit_pbr(LayeredFamily(), parameters, generator(), 5, 64)[0] for _ in range(2))
    torch.testing.assert_close(first, again, rtol=0, atol=0)


def test_a_layered_material_that_is_a_gltf_one_is_found_again():
    g = generator(1)
    parameters = torch.zeros(400, 14)
    parameters[:, :3] = 0.2 + 0.6 * torch.rand(400, 3, generator=g)
    parameters[:, 3] = (torch.rand(400, generator=g) > 0.5).float()
    parameters[:, 4] = 0.3 + 0.5 * torch.rand(400, generator=g)
    parameters[:, 5] = 0.5
    fitted, _ = fit_pbr(LayeredFamily(), parameters, g, num_materials=64)
    errors = (fitted - parameters[:, [0, 1, 2, 4, 3]]).abs().mean(dim=0)
    assert (errors < torch.tensor([0.06] * 4 + [0.1])).all()


@needs_xatlas
def test_impossible_sizes_and_what_is_missing_are_refused(monkeypatch):
    for size in (0, 15, 8193):
        with pytest.raises(ConfigError, match=f"--texture-size is {size}; choose 16 to 8192"):
            MaterialProduct(texture_size=size)
    with pytest.raises(ConfigError, match="--texture-size"):
        unwrapped(ball(5), 16)  # too small for the charts
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(ConfigError, match="-m pip install xatlas"):
        unwrapped(ball(1), 64)


def unwrapped(mesh, texture_size):
    return unwrap(mesh.vertices.double().numpy(), mesh.faces.numpy(), texture_size)


def flat_texels(size, uv, faces):
    return texels_of(Atlas(np.arange(len(uv)), np.array(faces), np.array(uv, dtype=np.float32)), size)


@needs_xatlas
def test_charts_keep_every_triangle_lie_in_the_unit_square_and_share_no_texel(monkeypatch):
    mesh = ball()
    atlas = unwrapped(mesh, 256)
    assert len(atlas.faces) == len(mesh.faces)
    np.testing.assert_array_equal(atlas.vertices[atlas.faces], mesh.faces.numpy())
    assert 0 <= atlas.uv.min() <= atlas.uv.max() <= 1
    a, b, c = atlas.uv[atlas.faces].astype(np.float64).swapaxes(0, 1)
    areas = np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1))) / 2
    assert 0.3 < areas.sum() < 1
    assert (areas > 0).all()
    texels = texels_of(atlas, 256)
    assert len(np.unique(texels.places)) == len(texels.places)
    assert len(texels.places) == pytest.approx(areas.sum() * 256**2, rel=0.02)
    monkeypatch.setattr("unmix_plugin.products.atlas._CHUNK", 37)
    parts = texels_of(atlas, 256)
    np.testing.assert_array_equal(parts.places, texels.places)
    np.testing.assert_array_equal(parts.triangles, texels.triangles)


@needs_xatlas
def test_texels_show_the_points_of_the_surface_that_their_centres_map_to():
    mesh, size = ball(3), 128
    atlas = unwrapped(mesh, size)
    texels = texels_of(atlas, size)
    centres = np.stack([texels.places % size + 0.5, texels.places // size + 0.5], axis=1) / size
    np.testing.assert_allclose(texels.of_corners(atlas.uv, atlas.faces), centres, atol=1e-6)
    positions = texels.of_corners(mesh.vertices.numpy(), atlas.vertices[atlas.faces])
    radii = np.linalg.norm(positions, axis=1)
    assert 0.985 < radii.min() <= radii.max() < 1 + 1e-6


def test_two_triangles_that_fill_the_square_have_all_texels_once_and_one_without_area_has_none():
    texels = flat_texels(32, [[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(texels.places, np.arange(32 * 32))
    assert set(texels.triangles.tolist()) == {0, 1}
    np.testing.assert_allclose(texels.weights.sum(axis=1), 1, atol=1e-12)
    assert len(flat_texels(64, [[0.1, 0.1], [0.6, 0.6], [0.35, 0.35]], [[0, 1, 2]]).places) == 0


def test_a_texture_has_the_values_of_its_texels_and_beyond_them_those_of_the_nearest():
    texels = flat_texels(8, [[0, 0], [0.5, 0], [0.5, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]])
    picture = texels.texture((texels.places // 8)[:, None].astype(np.float32))
    np.testing.assert_array_equal(picture[..., 0], np.repeat(np.arange(8.0)[:, None], 8, axis=1))


@needs_xatlas
def test_tiny_triangles_are_placed_too():
    mesh = ball(4)
    atlas = unwrap(1e-5 * mesh.vertices.double().numpy(), mesh.faces.numpy(), 512)
    edges = np.linalg.norm(atlas.uv[atlas.faces] - atlas.uv[np.roll(atlas.faces, 1, axis=1)], axis=2)
    assert edges.max() < 4 * np.median(edges)
