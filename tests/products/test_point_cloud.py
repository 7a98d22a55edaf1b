import numpy as np
import pytest
import torch
from plyfile import PlyData

from tests.products.ball_model import ALL_ROUND, RADIUS, ball_scene, cameras_around
from tests.trained.camera_files.camera_scenes import FRAME
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.products.point_cloud import _require_count, _require_point_scores, _write_point_cloud
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.surface import SeenSurface

SCENE = ball_scene()


@pytest.fixture(scope="module")
def points():
    cameras = cameras_around(ALL_ROUND)
    surface = SeenSurface(SCENE, 12_000, cameras)
    for camera in cameras:
        surface.look(camera)
    return surface.points()


@pytest.fixture(scope="module")
def cloud(points, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cloud")
    path, count = _write_point_cloud(folder, points, 800, SCENE.materials, FRAME)
    return PlyData.read(path), count


def columns(cloud, names):
    return np.stack([np.asarray(cloud["vertex"][name]) for name in names], axis=1)


def test_points_are_in_the_world_of_the_scene(cloud):
    ply, count = cloud
    assert 600 < count == ply["vertex"].count <= 800
    center = FRAME.to_world(np.zeros(3))
    radii = np.linalg.norm(columns(ply, "xyz") - center, axis=1)
    np.testing.assert_allclose(radii, RADIUS / FRAME.scale, atol=0.02 / FRAME.scale)


def test_normals_are_unit_vectors_out_of_the_surface_in_the_world(cloud):
    ply, _ = cloud
    outwards = columns(ply, "xyz") - FRAME.to_world(np.zeros(3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    normals = columns(ply, ("nx", "ny", "nz"))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert (normals * outwards).sum(axis=1).min() > 0.9


def test_each_point_has_material_abundances_and_the_colour_of_its_diffuse_spectrum(cloud):
    ply, _ = cloud
    names = [f"abundance_endmember_{index}" for index in range(3)]
    shares = columns(ply, names)
    assert shares.dtype == np.float32
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-5)
    height = FRAME.to_model(columns(ply, "xyz").astype(np.float64))[:, 2]
    material = np.asarray(ply["vertex"]["material"])
    assert (material[height > 0.05] == 0).all()
    assert (material[height < -0.05] == 1).all()
    top = np.flatnonzero(shares[:, 0] == 1)[0]
    spectrum = 0.8 * SCENE.materials.endmembers[0].detach().double()
    linear = (spectrum @ rgb_matrix(SCENE.bands, torch.float64)).clamp(0, 1)
    expected = 255 * linear_to_srgb(linear).numpy()
    np.testing.assert_allclose(columns(ply, ("red", "green", "blue"))[top], expected, atol=1)


def test_the_file_says_what_it_is(cloud):
    ply, _ = cloud
    assert ply.comments[0] == "surface points of an unmix-nerf run"
    assert "coordinates: world of the scene's transforms.json" in ply.comments[1]
    assert ply.comments[2:] == [f"material {index}: endmember_{index}" for index in range(3)]


def test_indices_and_targets_are_written_for_each_point(points, tmp_path):
    spectra = SCENE.materials.endmembers.detach().double().numpy()
    write_spectra_csv(tmp_path / "top.csv", SpectraTable(SCENE.bands, ("top",), spectra[:1]))
    asked = ["index:r650/r500", "index:pri", f"target:{tmp_path / 'top.csv'}<0.1"]
    scores = _require_point_scores(asked, SCENE.bands)
    path, count = _write_point_cloud(tmp_path, points, 300, SCENE.materials, FRAME, scores)
    ply = PlyData.read(path)
    written = [ply["vertex"].properties[index].name for index in (-3, -2, -1)]
    assert written == ["index_1", "index_pri", "target_1"]
    found = columns(ply, written)
    assert found.dtype == np.float32
    assert found.shape == (count, 3)
    shares = columns(ply, [f"abundance_endmember_{index}" for index in range(3)])
    seen = shares @ spectra
    np.testing.assert_allclose(found[:, 0], seen[:, 4] / seen[:, 1], rtol=1e-4)
    material = np.asarray(ply["vertex"]["material"])
    pure = shares.max(axis=1) > 0.999
    np.testing.assert_array_equal(found[pure, 2], material[pure] == 0)
    assert "index_1: index:r650/r500, formula r650/r500" in ply.comments[-3]
    assert ply.comments[-3].endswith("of radiance, since the scene's light is unknown")


def test_nothing_to_export_is_said(points, tmp_path):
    nothing = points.select(torch.zeros(len(points), dtype=torch.bool))
    with pytest.raises(RunError, match="no ray of the run's cameras ends on a surface"):
        _write_point_cloud(tmp_path, nothing, 800, SCENE.materials, FRAME)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("count", [0, -3, 10_000_001])
def test_an_impossible_number_of_points_is_refused(count):
    with pytest.raises(ConfigError, match=f"--num-points is {count}; choose 1 to 10000000"):
        _require_count(count)
