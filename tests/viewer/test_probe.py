"""What a point is made of, and its CSV."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.edited_scenes import CAMERAS, lit_scene
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.measures import Scale
from unmix_plugin.viewer.panels.probe import ProbedPoint, abundances_csv, spectra_csv, surface_at
from unmix_plugin.viewer.view_cameras import camera_of, pose_of

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
WORLD = Normalisation(TURN, np.array([0.3, -2.0, 5.0]), 0.25)


@pytest.fixture
def camera(source):
    return camera_of(pose_of(source.record.train_cameras[0]), 200)


def probed(scene, camera, column, row):
    return ProbedPoint(1, *surface_at(scene, camera, (column, row)), scene.materials)


@pytest.fixture
def taken(source, camera):
    before = torch.get_rng_state()
    with source.locked() as scene:
        found = probed(scene, camera, camera.width / 2, camera.height / 2)
    assert torch.equal(torch.get_rng_state(), before)
    return found


def test_a_probe_is_what_the_picture_shows_there(source, camera, taken):
    row, column = camera.height // 2, camera.width // 2
    with source.locked() as scene:
        outputs = scene.render(camera, ["spectral", "abundances"])
    np.testing.assert_allclose(taken.predicted, outputs["spectral"][row, column], rtol=1e-5)
    assert taken.found.abundances.sum() == pytest.approx(1)


@pytest.mark.parametrize("method", ["abundances", "probe"])
def test_the_material_of_a_probe_is_that_of_the_segmentation(method):
    scene, camera = lit_scene(), CAMERAS[0].resized(60, 50)
    scene = replace(scene, materials=replace(scene.materials, segmentation=method))
    ids = scene.look(camera)["segmentation"]
    places = (ids < 255).nonzero()[::80].tolist()
    found = [probed(scene, camera, column + 0.5, row + 0.5).material for row, column in places]
    assert found == [scene.materials.names[int(ids[row, column])] for row, column in places]
    assert len(set(found)) > 1


def test_a_probe_lies_on_the_ray_through_the_click(camera, taken):
    coords, depth = camera.project(torch.tensor(taken.point[None]).float(), 0)
    assert depth[0] > 0
    assert coords[0].tolist() == pytest.approx([camera.width / 2, camera.height / 2], abs=1.0)


def test_what_users_read_of_a_place_is_in_the_world(source, camera, taken):
    with source.locked() as scene:
        moved = probed(replace(scene, frame=WORLD), camera, camera.width / 2, camera.height / 2)
    np.testing.assert_array_equal(moved.point, taken.point)
    expected = WORLD.to_world(taken.point[None])[0]
    np.testing.assert_allclose(moved.world, expected, rtol=1e-6)
    rows = list(csv.reader(io.StringIO(abundances_csv([moved]).decode())))
    np.testing.assert_allclose([float(value) for value in rows[1][1:4]], expected, rtol=1e-6)


def test_where_nothing_is_there_is_nothing_to_probe(source, camera):
    away = camera.camera_to_world.clone()
    away[0, :, 3] *= 50
    away[0, :, 1:3] *= -1  # looks the other way
    with source.locked() as scene, pytest.raises(ConfigError, match="nothing is there"):
        surface_at(scene, replace(camera, camera_to_world=away), (100.0, 100.0))


def test_the_files_of_probes_hold_every_number(taken):
    odd = replace(taken.materials, names=("a,b", 'c"d', "e"))  # stay one field each
    taken = replace(taken, materials=odd)
    measured = replace(taken, number=2, measured=taken.predicted * 2, measured_in="train_003")
    rows = list(csv.reader(io.StringIO(spectra_csv([taken, measured]).decode())))
    assert rows[0] == ["wavelength", "probe_1_predicted", "probe_2_predicted", "probe_2_measured"]
    values = np.array(rows[1:], dtype=float)
    np.testing.assert_allclose(values[:, 0], taken.materials.bands.centers_nm)
    np.testing.assert_allclose(values[:, 3], 2 * taken.predicted, rtol=1e-7)
    measured = replace(measured, materials=replace(odd, light=torch.ones(5), light_name="A"))
    rows = list(csv.reader(io.StringIO(abundances_csv([taken, measured]).decode())))
    assert rows[0][:7] == ["probe", "x", "y", "z", "metres_per_unit", "material", "measured_in"]
    assert rows[0][7:9] == ["quantity", "light"]
    names = taken.materials.names
    assert rows[0][9:] == [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    assert [rows[2][4], *rows[2][6:9]] == ["", "train_003", "reflectance", "A"]
    assert rows[1][7:9] == ["radiance", ""]
    np.testing.assert_allclose([float(value) for value in rows[1][9::3]], taken.found.abundances, atol=1e-5)
    np.testing.assert_allclose([float(value) for value in rows[1][1:4]], taken.world, rtol=1e-7)
    renamed = replace(taken, materials=replace(odd, names=("e", "new", "a,b")))
    rows = list(csv.reader(io.StringIO(abundances_csv([taken, renamed]).decode())))
    assert rows[0][9::3] == ["a,b", 'c"d', "e", "new"]
    assert rows[2][9::3] == [rows[1][15], "", rows[1][9], rows[1][12]]
    rows = list(csv.reader(io.StringIO(abundances_csv([taken], Scale(0.25, "known")).decode())))
    assert rows[1][4] == "0.25"
