"""`unmix-image`: what it prints, writes and refuses."""

import csv

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat

from tests.factories.commands import done, picture_size, refused, run
from tests.factories.files import write_envi
from tests.factories.mixtures import smooth_endmembers
from tests.spectral.unmixing.test_image import image_of
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.commands.image import image
from unmix_plugin.errors import SpectrumError
from unmix_plugin.formats.envi import write_envi_cube
from unmix_plugin.spectral.bands import Bands

pytestmark = pytest.mark.usefixtures("few_searches")
UNKNOWN_LIGHT = "does not say that it holds reflectance. If it does not, the light of the scene is unknown"


@pytest.fixture
def cube():
    return image_of(smooth_endmembers(3), size=20).astype(np.float32)


def test_spectra_maps_and_shares_are_written_and_said(cube, tmp_path):
    bands = Bands.of(np.linspace(450, 900, cube.shape[2]))
    write_envi_cube(tmp_path / "field", cube, bands, None, "a field")
    words = (tmp_path / "field.hdr", "--endmembers", 3, "--output-dir", tmp_path / "out")
    words += ("--library", "+builtin", "--mnf", 2)
    ended = done(image, *words)
    assert "20 x 20 pixels, 24 bands" in ended.out
    assert ended.out.count("% of the area") == 3
    assert UNKNOWN_LIGHT in ended.out
    folder = tmp_path / "out" / "field"
    with (folder / "endmembers.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["wavelength", "material 1", "material 2", "material 3"]
    assert float(rows[1][0]) == 450
    abundances = open_spectral_file(folder / "abundances.hdr").read()
    assert abundances.shape == (20, 20, 3)
    np.testing.assert_allclose(abundances.reshape(-1, 3)[1:].sum(axis=1), 1, atol=1e-5)
    ends = open_spectral_file(folder / "intervals.hdr").read().reshape(-1, 2, 3)[1:]
    own = abundances.reshape(-1, 3)[1:]
    assert ((ends[:, 0] <= own + 1e-6) & (own <= ends[:, 1] + 1e-6)).all()
    assert open_spectral_file(folder / "mnf.hdr").read().shape == (20, 20, 2)
    assert len((folder / "mnf.csv").read_text().splitlines()) == 1 + 24
    with (folder / "angles.csv").open() as file:
        angles = list(csv.DictReader(file))
    assert [angles[0][key] for key in ("known", "bands")] == ["ColorChecker/blue sky", "17"]
    assert 0 < float(angles[0]["material 1"]) < np.pi / 2
    for name in ("endmembers.png", "maps.png"):
        assert min(picture_size(folder / name)) > 200
    assert "exist already; give --overwrite or another folder" in refused(image, *words)
    assert UNKNOWN_LIGHT not in done(image, *words[:-4], "--overwrite").out
    left = {path.name for path in folder.glob("[!.]*")}
    assert (len(left), left & {"angles.csv", "mnf.csv", "mnf.hdr", "mnf.img"}) == (10, set())


def test_files_that_only_other_options_write_are_not_taken_away_unasked(cube, tmp_path):
    write_envi_cube(tmp_path / "field", cube, Bands.of(np.linspace(450, 900, cube.shape[2])), None, "a field")
    own = tmp_path / "field" / "mnf.hdr"
    own.parent.mkdir()
    own.write_text("of another program")
    said = refused(image, tmp_path / "field.hdr", "--endmembers", 3, "--output-dir", tmp_path)
    assert f"{own} exists already; give --overwrite" in said
    assert own.read_text() == "of another program"


@pytest.mark.parametrize(
    ("name", "field", "is_said"),
    [
        ("field", "reflectance scale factor = 1", True),
        ("field", "data gain values = {2}", False),
        ("field_reflectance", "", True),
    ],
)
def test_angles_are_of_radiance_unless_the_file_speaks_of_reflectance(name, field, is_said, cube, tmp_path):
    write_envi_cube(tmp_path / name, cube, Bands.of(np.linspace(450, 900, cube.shape[2])), None, "a field")
    with (tmp_path / f"{name}.hdr").open("a") as header:
        header.write(f"{field}\n")
    words = ("--endmembers", 3, "--output-dir", tmp_path / "out", "--library", "+builtin")
    assert (UNKNOWN_LIGHT not in done(image, tmp_path / f"{name}.hdr", *words).out) == is_said


def test_bands_without_wavelengths_are_numbered_and_pixels_without_measurement_left_out(cube, tmp_path):
    cube[:4] = np.nan
    np.save(tmp_path / "plain.npy", cube)
    ended = done(image, tmp_path / "plain.npy", "--endmembers", 3, "--axes", "yxb", "--output-dir", tmp_path)
    assert "80 pixels without a measurement" in ended.out
    with (tmp_path / "plain" / "endmembers.csv").open() as file:
        assert next(csv.reader(file))[0] == "band"
    assert not open_spectral_file(tmp_path / "plain" / "abundances.hdr").read()[:4].any()


def test_bands_that_were_measured_nowhere_are_left_out(cube, tmp_path):
    cube[..., 5:8] = -9999
    cube[:2] = -9999
    bands = Bands.of(np.linspace(450, 900, cube.shape[2]))
    write_envi_cube(tmp_path / "a", cube, bands, None, "a", {"data ignore value": -9999})
    ended = done(image, tmp_path / "a.hdr", "--endmembers", 3, "--output-dir", tmp_path)
    assert "3 bands left out" in ended.out
    assert "40 pixels without a measurement" in ended.out
    with (tmp_path / "a" / "endmembers.csv").open() as file:
        found = [float(row[0]) for row in list(csv.reader(file))[1:]]
    np.testing.assert_allclose(found, np.delete(bands.centers_nm, slice(5, 8)))


@pytest.mark.parametrize("field", ["", "bbl = {0, " + "1, " * 22 + "1}"])
def test_a_band_without_numbers_makes_no_raw_counts_of_reflectances(field, cube, tmp_path):
    cube[..., 0] = np.nan
    write_envi_cube(tmp_path / "a", cube, Bands.of(np.linspace(450, 900, cube.shape[2])), None, "a field")
    with (tmp_path / "a.hdr").open("a") as header:
        header.write(f"{field}\n")
    said = done(image, tmp_path / "a.hdr", "--endmembers", 3, "--output-dir", tmp_path).out
    assert "1 band left out" in said
    assert "raw counts" not in said


def test_a_no_data_value_that_the_file_does_not_name_is_said_and_noise_around_black_is_none(cube, tmp_path):
    bands = Bands.of(np.linspace(450, 900, cube.shape[2]))
    for number, is_said in ((-9999, True), (-0.001, False)):
        cube[:3] = number
        write_envi_cube(tmp_path / "a", cube, bands, None, "a field")
        words = "--endmembers", 3, "--output-dir", tmp_path, "--overwrite"
        said = done(image, tmp_path / "a.hdr", *words).out
        assert (f"many pixels hold {number:g} in every band" in said) == is_said


def test_a_matrix_of_bands_and_pixels_is_an_image_by_its_size(cube, tmp_path):
    savemat(tmp_path / "list.mat", {"Y": cube.reshape(-1, 24, order="F").T})
    ended = done(image, tmp_path / "list.mat", "--size", 20, 20, "--endmembers", 3, "--output-dir", tmp_path)
    assert "20 x 20 pixels, 24 bands" in ended.out


@pytest.mark.parametrize("gain", [1, 2])
def test_the_dark_lines_of_a_file_are_subtracted_from_raw_numbers_alone(cube, gain, tmp_path, monkeypatch):
    more = "" if gain == 1 else "\ndata gain values = {" + ", ".join(["2"] * 24) + "}"
    counts = np.round(cube * 10000).astype(np.uint16)
    dark = np.broadcast_to(np.arange(100, 124, dtype=np.uint16), (5, *counts.shape[1:]))
    falling = "\nwavelength units = nm\nwavelength = {" + ", ".join(map(str, range(900, 660, -10))) + "}\n"
    numbers = np.concatenate([counts + dark[:1], dark])
    header = write_envi(tmp_path / "a.hdr", numbers, "bil", f"{falling}autodarkstartline = 20{more}")
    taken = []

    def take(values, *_, **__):
        taken.append(values)
        raise SpectrumError("taken")

    monkeypatch.setattr("unmix_plugin.spectral.unmixing.image.unmix_image", take)
    run(image, header, "--endmembers", 3, "--output-dir", tmp_path)
    expected = counts if gain == 1 else 2.0 * (counts + dark[:1])
    np.testing.assert_allclose(taken[0], expected[..., ::-1])


def unmixed(monkeypatch, *words):
    """What is unmixed with these words, its mask, and what is printed."""
    taken = []

    def take(values, *_, mask, **__):
        taken.append((values, mask))
        raise SpectrumError("taken")

    monkeypatch.setattr("unmix_plugin.spectral.unmixing.image.unmix_image", take)
    ended = run(image, *words, "--endmembers", 3)
    assert taken, ended.err
    return *taken[0], ended.out


@pytest.fixture
def raw(cube, tmp_path):
    """Raw counts of reflectances under a lamp, with a white panel of 0.5 and a dark frame."""
    lamp, dark = np.linspace(3000, 9000, 24), np.linspace(100, 300, 24)
    rng, columns = np.random.default_rng(0), np.linspace(0.8, 1.2, 20)[:, None]
    named = "wavelength units = nm\nwavelength = {" + ", ".join(map(str, range(450, 690, 10))) + "}\n"

    def counts(values):
        return np.rint(values * lamp * columns + dark + rng.normal(0, 1, values.shape)).astype(np.uint16)

    for name, values in (
        ("view", cube),
        ("white", np.full((9, 20, 24), 0.5)),
        ("dark", np.zeros((9, 20, 24))),
    ):
        write_envi(tmp_path / f"{name}.hdr", counts(values), "bil", named)
    return tmp_path


def test_raw_counts_become_reflectance_by_white_and_dark(cube, raw, monkeypatch):
    words = (
        raw / "view.hdr",
        "--white",
        raw / "white.hdr",
        "--dark",
        raw / "dark.hdr",
        "--output-dir",
        raw / "out",
    )
    values, mask, said = unmixed(monkeypatch, *words, "--white-reflectance", 0.5)
    assert mask.all()
    np.testing.assert_allclose(values, cube, atol=0.01)
    assert "raw counts" not in said
    assert "mean of 9 lines, column by column" in said
    (raw / "panel.csv").write_text("Wellenlänge [nm];Reflexion (%)\n440;50,0\n700;50,0\n", "cp1252")
    values, _, _ = unmixed(monkeypatch, *words, "--white-reflectance", raw / "panel.csv")
    np.testing.assert_allclose(values, cube, atol=0.01)


def test_raw_counts_without_a_white_are_said_to_be_raw(cube, raw, monkeypatch):
    _, _, said = unmixed(monkeypatch, raw / "view.hdr", "--output-dir", raw / "out")
    assert "looks wrong: the numbers are raw counts" in said
    assert "give --white and --dark" in said
    _, _, said = unmixed(
        monkeypatch, raw / "view.hdr", "--white", raw / "white.hdr", "--output-dir", raw / "out"
    )
    assert "no dark frame" in said
    bands = Bands.of(np.linspace(450, 900, cube.shape[2]))
    write_envi_cube(raw / "field", cube, bands, None, "a field")
    _, _, said = unmixed(monkeypatch, raw / "field.hdr", "--output-dir", raw / "out")
    assert "raw counts" not in said


def test_pixels_that_are_black_in_a_mask_are_left_out(raw, monkeypatch):
    shown = np.zeros((20, 20), bool)
    shown[4:12, 3:17] = True
    Image.fromarray((shown * 255).astype(np.uint8)).save(raw / "mask.png")
    words = raw / "view.hdr", "--mask", raw / "mask.png", "--output-dir", raw / "out"
    _, mask, said = unmixed(monkeypatch, *words)
    np.testing.assert_array_equal(mask, shown)
    assert "pixels left out by" in said
    Image.fromarray(np.zeros((20, 19), np.uint8)).save(raw / "mask.png")
    assert "mask.png" in refused(image, *words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--white-reflectance", "0.9"), "--white-reflectance needs a white reference"),
        (("--white", "{0}/none.hdr"), "no such file"),
        (("--white", "{0}/dark.hdr", "--dark", "{0}/white.hdr"), "are white and dark swapped"),
    ],
)
def test_references_that_can_t_be_are_refused(words, message, raw):
    told = [word.format(raw) for word in words]
    assert message in refused(image, raw / "view.hdr", *told, "--output-dir", raw / "out")


@pytest.mark.parametrize(
    ("change", "words", "message"),
    [
        (lambda cube: 0 * cube, (), "the image is black"),
        (lambda cube: np.full_like(cube, np.nan), (), "no pixel holds a measurement in all bands"),
        (lambda cube: cube[5:6, 5:6], (), "only 1 distinct pixels"),
        (np.array, ("--library", "+builtin"), "its wavelengths are not known, so no spectrum of a library"),
        (np.array, ("--mnf", -1), "--mnf is -1; expected 1 to 24"),
        (np.array, ("--mnf", 25), "--mnf is 25; expected 1 to 24"),
        (np.array, ("--endmembers", 30), "between 1 and the number of bands, 24; found 30"),
    ],
)
def test_what_cannot_be_unmixed_ends_with_one_message(change, words, message, cube, tmp_path):
    np.save(tmp_path / "bad.npy", change(cube))
    given = ["--axes", "yxb", "--output-dir", tmp_path, *(words or ("--endmembers", 3))]
    ended = run(image, tmp_path / "bad.npy", *given)
    assert (ended.status, len(ended.err.strip().splitlines())) == (2, 1)
    assert message in ended.err


def test_the_place_on_the_earth_is_kept_and_a_repeated_wavelength_left_out(cube, tmp_path):
    nm = np.linspace(450, 900, cube.shape[2])
    place = "UTM, 1, 1, 5e5, 4.5e6, 2, 2, 33, North"
    on_map = {"map info": place, "coordinate system string": 'PROJCS["x", 1]'}
    write_envi_cube(tmp_path / "field", cube, Bands.of(nm), None, "a field", on_map)
    header = (tmp_path / "field.hdr").read_text()
    (tmp_path / "field.hdr").write_text(header.replace(f"{float(nm[3])!r},", f"{float(nm[2])!r},"))
    words = ["--endmembers", 3, "--mnf", 2, "--output-dir", tmp_path / "out"]
    ended = done(image, tmp_path / "field.hdr", *words)
    assert "1 band left out: marked as bad in the file, of a wavelength that is there twice" in ended.out
    for name in ("abundances", "confidence", "mnf"):
        assert open_spectral_file(tmp_path / "out" / "field" / f"{name}.hdr").map_entries == on_map


def test_a_picture_is_unmixed_in_linear_light(tmp_path):
    materials = np.array([[0.9, 0.1, 0.05], [0.05, 0.1, 0.8]])
    share = np.linspace(0, 1, 64)[:, None]
    light = (share * materials[0] + (1 - share) * materials[1]).repeat(4, axis=0).reshape(16, 16, 3)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    Image.fromarray(np.rint(255 * coded).astype(np.uint8)).save(tmp_path / "a.png")
    ended = done(image, tmp_path / "a.png", "--endmembers", 2, "--output-dir", tmp_path)
    assert "the picture is taken as sRGB and brought to linear light" in ended.out
    misfit = open_spectral_file(tmp_path / "a" / "confidence.hdr").read()[..., 1]
    assert misfit.mean() < 0.01
