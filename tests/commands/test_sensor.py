"""`--sensor`: files have the sensor's bands, materials stay, and products that would mix bands refuse."""

import numpy as np
import pytest

from tests.factories.commands import done, refused
from tests.factories.renders import read_envi
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import read_sensor
from unmix_plugin.trained.open_run import load_run

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk", "coarse_surfaces")

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
    ended = done(render, *words, *outputs, "--output", tmp_path / "seen", "--sensor", camera)
    said = " ".join((ended.out + ended.err).split())
    assert "seen through toy: blue 4" in said
    assert "left out nir (900-950 nm): the bands cover" in said
    done(render, *words, *outputs, "--output", tmp_path / "all")
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


def test_known_spectra_are_not_compared_with_broad_channels(solid, camera, tmp_path):
    words = ["--run", solid.run, "--device", "cpu", "--output", tmp_path / "out", "--sensor", camera]
    done(export, "endmembers", *words[:-2])
    assert (tmp_path / "out" / "angles.csv").exists()
    said = " ".join(done(export, "endmembers", *words, "--overwrite").out.split())
    assert "without angles.csv: known spectra are compared in the run's own bands" in said
    assert not (tmp_path / "out" / "angles.csv").exists()
    done(export, "endmembers", "--run", solid.run, "--output", tmp_path / "all")
    tables = (tmp_path / name / "endmembers.csv" for name in ("all", "out"))
    whole, seen = (np.loadtxt(table, delimiter=",", skiprows=1) for table in tables)
    expected = seen_by(camera, solid)
    np.testing.assert_allclose(seen[:, 0], expected.bands.centers_nm)
    np.testing.assert_allclose(seen[:, 1:], expected.matrix.T @ whole[:, 1:], atol=1e-5)
    said = refused(export, "endmembers", *words, "--overwrite", "--library", "+builtin")
    assert "leave out --library or --sensor" in said
    for command in ([render], [export, "point-cloud"]):
        said = refused(*command, *words, "--overwrite", "--outputs", "library:+builtin")
        assert "library:+builtin compares with spectra known in the run's own bands" in said


@pytest.mark.parametrize(
    "words",
    [
        ["abundances", "--formats", "npy", "png", "envi", "exr"],
        ["cubes", "--formats", "npy", "envi", "exr"],
        ["mesh", "--resolution", 24],
        ["point-cloud", "--num-points", 300],
        ["segmentation"],
        ["volume", "--resolution", 8],
    ],
    ids=lambda words: words[0],
)
def test_every_other_product_that_takes_a_sensor_is_written(solid, camera, tmp_path, words):
    done(export, *words, "--run", solid.run, "--output", tmp_path, "--device", "cpu", "--sensor", camera)
    if words[0] == "cubes":
        cube, header = read_envi(tmp_path / "eval_002")
        assert cube.shape == np.load(tmp_path / "eval_002.npy").shape == (16, 16, 3)
        assert [float(nm) for nm in header["wavelength"]] == seen_by(camera, solid).bands.centers_nm.tolist()
    if words[0] == "volume":
        assert np.load(tmp_path / "volume.npz")["endmembers"].shape[1] == 3


@pytest.mark.parametrize("name", ["report", "metamerism", "spectrum"])
def test_products_that_compare_in_the_runs_own_bands_refuse(solid, camera, tmp_path, name):
    words = ["--view", "0", "--pixel", "1,1"] if name == "spectrum" else []
    said = refused(export, name, *words, "--run", solid.run, "--output", tmp_path / "out", "--sensor", camera)
    assert f"{name} compares with what is known in the run's own bands" in said
    others = (
        "abundances, cubes, endmembers, mesh, page, point-cloud, poses, regions, segmentation, splats, volume"
    )
    assert f"It goes with {others}" in said
    words = ["--run", solid.run, "--output", tmp_path / "out", "--sensor", tmp_path / "none.csv"]
    assert "can't read spectra" in refused(render, *words)
    assert not (tmp_path / "out").exists()
