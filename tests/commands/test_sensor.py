"""`--sensor`: files have the sensor's bands, materials stay, and products that would mix bands refuse."""

import numpy as np
import pytest
from plyfile import PlyData

from tests.commands.running import run
from tests.products.render.render_factory import read_envi
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.editing.edited_run import load_edited_run
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import read_sensor
from unmix_plugin.trained.open_run import load_run

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")

RESPONSES = """wavelength,red,green,blue,nir
430,0,0,1,0
480,0,0.2,1,0
530,0,1,0.1,0
580,0.4,0.3,0,0
620,1,0,0,0
660,0,0,0,0
899,0,0,0,0
900,0,0,0,1
950,0,0,0,1
"""


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    """A camera with three channels that the run's bands cover, and one that they don't."""
    path = tmp_path_factory.mktemp("camera") / "toy.csv"
    path.write_text(RESPONSES)
    return path


def seen_by(camera, solid):
    return read_sensor(camera).seen_by(Bands.of(load_run(solid.run, "cpu").record.metadata["wavelengths_nm"]))


def test_a_render_has_the_sensors_bands(solid, camera, tmp_path):
    words = ["--run", solid.run, "--device", "cpu", "--illuminant", "A", "--formats", "envi", "png", "npy"]
    outputs = ["--outputs", "spectral", "rgb", "segmentation", "abundances", "false-colour:617,530,460"]
    ended = run(render, *words, *outputs, "--output", tmp_path / "seen", "--sensor", camera)
    assert ended.status == 0, ended.err
    said = " ".join((ended.out + ended.err).split())
    assert "seen through toy: blue 4" in said
    assert "left out nir (900-950 nm): the bands cover" in said
    assert run(render, *words, *outputs, "--output", tmp_path / "all").status == 0
    expected = seen_by(camera, solid)
    spectra, header = read_envi(tmp_path / "seen" / "spectral" / "eval_002")
    assert [float(nm) for nm in header["wavelength"]] == expected.bands.centers_nm.tolist()
    whole = np.load(tmp_path / "all" / "spectral" / "eval_002.npy")
    np.testing.assert_allclose(spectra, whole @ expected.matrix, atol=1e-5)
    for name in ("abundances", "segmentation"):
        one, other = (np.load(tmp_path / folder / name / "eval_002.npy") for folder in ("seen", "all"))
        np.testing.assert_array_equal(one, other)
    rgb = np.load(tmp_path / "seen" / "rgb" / "eval_002.npy")
    assert np.abs(rgb - np.load(tmp_path / "all" / "rgb" / "eval_002.npy")).max() > 0.01


def test_a_point_cloud_has_other_colours_and_the_same_materials(solid, camera, tmp_path):
    words = ["point-cloud", "--run", solid.run, "--num-points", 300, "--device", "cpu"]
    clouds = []
    for name, more in (("all", []), ("seen", ["--sensor", camera])):
        ended = run(export, *words, "--output", tmp_path / name, *more)
        assert ended.status == 0, ended.err
        clouds.append(PlyData.read(tmp_path / name / "points.ply")["vertex"])
    whole, seen = clouds
    same = [field.name for field in whole.properties if field.name not in ("red", "green", "blue")]
    assert len(same) > 8
    for field in same:
        np.testing.assert_array_equal(seen[field], whole[field], err_msg=field)
    change = np.stack([seen[c].astype(int) - whole[c].astype(int) for c in ("red", "green", "blue")])
    assert 1 < np.abs(change).mean() < 60


def test_endmembers_are_the_runs_through_the_sensor(solid, camera, tmp_path):
    for name, more in (("all", []), ("seen", ["--sensor", camera])):
        ended = run(export, "endmembers", "--run", solid.run, "--output", tmp_path / name, *more)
        assert ended.status == 0, ended.err
    whole, seen = (
        np.loadtxt(tmp_path / name / "endmembers.csv", delimiter=",", skiprows=1) for name in ("all", "seen")
    )
    expected = seen_by(camera, solid)
    np.testing.assert_allclose(seen[:, 0], expected.bands.centers_nm)
    np.testing.assert_allclose(seen[:, 1:], expected.matrix.T @ whole[:, 1:], atol=1e-5)


def test_known_spectra_are_not_compared_with_broad_channels(solid, camera, tmp_path):
    words = ["--run", solid.run, "--device", "cpu", "--output", tmp_path / "out", "--sensor", camera]
    ended = run(export, "endmembers", *words)
    assert "without angles.csv: known spectra are compared in the run's own bands" in " ".join(
        ended.out.split()
    )
    assert (tmp_path / "out" / "endmembers.csv").is_file()
    assert not (tmp_path / "out" / "angles.csv").exists()
    refused = run(export, "endmembers", *words, "--overwrite", "--library", "+builtin")
    assert (refused.status, "leave out --library or --sensor" in refused.err) == (2, True)
    for command in ([render], [export, "point-cloud"]):
        refused = run(*command, *words, "--overwrite", "--outputs", "library:+builtin")
        assert refused.status == 2
        assert "library:+builtin compares with spectra known in the run's own bands" in " ".join(
            refused.err.split()
        )


@pytest.mark.parametrize(
    "words",
    [
        ["abundances", "--formats", "npy", "png", "envi", "exr"],
        ["cubes", "--formats", "npy", "envi", "exr"],
        ["mesh", "--resolution", 24],
        ["pca"],
        ["segmentation"],
        ["volume", "--resolution", 8],
    ],
    ids=lambda words: words[0],
)
def test_every_other_product_that_takes_a_sensor_is_written(solid, camera, tmp_path, words):
    ended = run(
        export, *words, "--run", solid.run, "--output", tmp_path, "--device", "cpu", "--sensor", camera
    )
    assert ended.status == 0, ended.err
    if words[0] == "cubes":
        assert np.load(tmp_path / "eval_002.npy").shape == (16, 16, 3)
        assert [float(nm) for nm in read_envi(tmp_path / "eval_002")[1]["wavelength"]] == seen_by(
            camera, solid
        ).bands.centers_nm.tolist()
    if words[0] == "volume":
        assert np.load(tmp_path / "volume.npz")["endmembers"].shape[1] == 3


def test_a_camera_of_one_channel_is_one_too(solid, tmp_path):
    path = tmp_path / "pan.csv"
    path.write_text("wavelength,pan\n450,1\n650,1\n")
    outputs = ["--outputs", "spectral", "rgb", "pca", "material_scores"]
    ended = run(render, "--run", solid.run, "--output", tmp_path / "out", *outputs, "--sensor", path)
    assert ended.status == 0, ended.err
    assert read_envi(tmp_path / "out" / "spectral" / "eval_002")[0].shape == (16, 16, 1)


@pytest.mark.parametrize(
    "words", [["report"], ["metamerism"], ["spectrum", "--view", "0", "--pixel", "1,1"]], ids=lambda w: w[0]
)
def test_products_that_compare_in_the_runs_own_bands_refuse(solid, camera, tmp_path, words):
    ended = run(export, *words, "--run", solid.run, "--output", tmp_path / "out", "--sensor", camera)
    assert ended.status == 2
    said = " ".join(ended.err.split())
    assert f"{words[0]} compares with what is known in the run's own bands" in said
    assert (
        "It goes with abundances, cubes, endmembers, mesh, page, pca, point-cloud, poses, regions, segmentation, "
        "splats, volume" in said
    )
    assert not (tmp_path / "out").exists()


def test_a_sensor_that_is_not_there_or_sees_nothing_exits_2(solid, tmp_path):
    far = tmp_path / "far.csv"
    far.write_text("wavelength,swir\n1565,1\n1655,1\n")
    for path, said in ((tmp_path / "none.csv", "can't read spectra"), (far, "sees nothing: the bands cover")):
        ended = run(render, "--run", solid.run, "--output", tmp_path / "out", "--sensor", path)
        assert ended.status == 2
        assert said in " ".join(ended.err.split())
    assert not (tmp_path / "out").exists()


def test_bands_light_and_notes_follow_and_the_run_stays(solid, camera):
    seen = load_edited_run(solid.run, "cpu", None, "A", camera).materials_scene
    lit = load_edited_run(solid.run, "cpu", None, "A").materials_scene
    expected = seen_by(camera, solid)
    np.testing.assert_allclose(seen.bands.centers_nm, expected.bands.centers_nm)
    assert seen.light_power is not None
    assert lit.light_power is not None
    np.testing.assert_allclose(seen.light_power, lit.light_power @ expected.matrix, rtol=1e-5)
    assert seen.notes == (*lit.notes, expected.description, *expected.notes)
