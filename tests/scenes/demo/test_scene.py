import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from tests.factories.demo_parts import LAMP, PLACEMENTS, one_ray_a_pixel
from unmix_plugin.errors import ConfigError, SceneError, SpectrumError
from unmix_plugin.scenes.demo import scene as demo_scene
from unmix_plugin.scenes.demo.shading import MATERIALS, band_centers_nm, lamp_power, reflectances, trace
from unmix_plugin.scenes.demo.shapes import first_hits
from unmix_plugin.spectral.library.spectra_csv import read_spectra


@pytest.fixture(scope="module")
def view():
    """One evaluation view at a size where every material and every kind of pixel occurs."""
    return demo_scene.render_view(demo_scene.demo_cameras(48, 8), 2)


def spectral_angle(a, b):
    return np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))


def spectra_of(bands):
    wavelengths = band_centers_nm(bands)
    return reflectances(wavelengths), lamp_power(wavelengths)


def test_a_lit_matt_pixel_of_one_material_is_reflectance_times_lamp_times_shading(view):
    spectra, lamp = spectra_of(31)
    cube = demo_scene.radiance_cube(view, spectra, lamp)
    for k in range(len(MATERIALS)):
        pure = (view.alpha == 1) & (view.abundances[..., k] > 0.9999) & (view.specular == 0)
        if MATERIALS[k] == "green":  # the glossy apple only: no pixel of it is without a trace of highlight
            continue
        assert pure.any(), MATERIALS[k]
        shading = view.diffuse[pure][:, k]
        assert_allclose(cube[pure], shading[:, None] * (spectra[k] * lamp), atol=1e-4)
        assert ((shading > 0) & (shading <= 1.05)).all()


def test_what_a_highlight_adds_to_the_same_point_has_the_lamps_colour():
    spectra, lamp = spectra_of(31)
    rays = demo_scene.demo_cameras(64, 8).image_rays(2)
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    brightest = trace(origins, directions, LAMP[None]).specular.argmax()
    distances, _ = first_hits(PLACEMENTS, origins, directions)
    point = origins[brightest] + distances[brightest] * directions[brightest]
    eyes = np.stack([origins[brightest], point + 2 * np.array([0, 0.3, 1], dtype=np.float32)])
    towards = (point - eyes) / np.linalg.norm(point - eyes, axis=1, keepdims=True)
    seen = trace(eyes, towards.astype(np.float32), LAMP[None])
    assert seen.specular[0] > 0.5
    assert seen.specular[1] < 0.1
    radiances = (seen.diffuse @ spectra + seen.specular[:, None]) * lamp
    assert spectral_angle(radiances[0] - radiances[1], lamp) < 0.01
    assert spectral_angle(radiances[1], lamp) > 0.2


def test_abundances_lie_on_the_simplex_and_labels_are_the_largest_where_half_a_pixel_is_covered(view):
    sums, labels, labelled = view.abundances.sum(axis=-1), demo_scene.label_image(view), view.alpha >= 0.5
    assert (view.abundances >= 0).all()
    assert_allclose(sums[view.alpha > 0], 1, atol=1e-5)
    assert (sums[view.alpha == 0] == 0).all()
    assert (labels[~labelled] == 255).all()
    assert (labels[labelled] == view.abundances[labelled].argmax(axis=-1)).all()
    assert set(np.unique(labels[labelled])) == set(range(len(MATERIALS)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    directory = tmp_path_factory.mktemp("demo") / "scene"
    demo_scene.make_demo_scene(directory, size=24, bands=7, views=7)
    return directory


@pytest.fixture
def coarse():
    with one_ray_a_pixel() as patch:
        yield patch


@pytest.fixture
def small_default(coarse):
    for name, value in (("DEFAULT_SIZE", 16), ("DEFAULT_BANDS", 3), ("DEFAULT_VIEWS", 4)):
        coarse.setattr(demo_scene, name, value)


def files_in(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_scene_has_the_layout_that_transforms_json_names(folder):
    """Every fourth view is for evaluation and has abundances."""
    transforms = json.loads((folder / "transforms.json").read_text())
    assert (transforms["w"], transforms["h"], len(transforms["wavelengths"])) == (24, 24, 7)
    assert transforms["materials"] == list(MATERIALS)
    assert demo_scene.is_complete(folder)
    evaluation = [f"images/{demo_scene.frame_name(i)}.png" for i in (2, 6)]
    assert transforms["val_filenames"] == transforms["test_filenames"] == evaluation
    frames = {frame["file_path"]: frame for frame in transforms["frames"]}
    assert (len(frames), set(transforms["train_filenames"])) == (7, set(frames) - set(evaluation))
    for path, frame in frames.items():
        cube = np.load(folder / frame["hyperspectral_file_path"])
        alpha = np.asarray(Image.open(folder / path))[..., 3]
        labels = np.asarray(Image.open(folder / frame["seg_file_path"]))
        assert (cube.shape, cube.dtype, alpha.shape, labels.dtype) == ((24, 24, 7), "f2", (24, 24), "u1")
        assert 0 <= cube.min() <= cube.max() <= 1
        assert (cube[alpha == 0] == 0).all()
        assert (labels[alpha == 0] == 255).all()
        assert ("abundance_file_path" in frame) == (path in evaluation)
        if path in evaluation:
            abundances = np.load(folder / frame["abundance_file_path"]).astype(np.float32)
            assert_allclose(abundances.sum(axis=-1), alpha > 0, atol=2e-3)


@pytest.mark.usefixtures("coarse")
def test_another_light_changes_each_band_of_the_scene_by_one_factor(tmp_path):
    demo_scene.make_demo_scene(tmp_path / "day", size=16, bands=7, views=4)
    demo_scene.make_demo_scene(tmp_path / "lamp", size=16, bands=7, views=4, illuminant="A")
    lamps = [read_spectra(tmp_path / name / "illuminant.csv").spectra[0] for name in ("day", "lamp")]
    assert_allclose(lamps[1], lamp_power(band_centers_nm(7), "A"), rtol=1e-8)
    assert lamps[1].argmax() == 6 != lamps[0].argmax()
    cubes = [np.load(tmp_path / name / "cubes/eval_002.npy").astype(float) for name in ("day", "lamp")]
    lit = (cubes[0].max(axis=-1) < 0.99) & (cubes[0].min(axis=-1) > 0.02)
    assert lit.sum() > 20
    factors = np.broadcast_to(lamps[1] / lamps[0], (lit.sum(), 7))
    assert_allclose(cubes[1][lit] / cubes[0][lit], factors, rtol=0.02)


def test_a_scene_written_twice_has_the_same_bytes(folder, tmp_path):
    demo_scene.make_demo_scene(tmp_path / "again", size=24, bands=7, views=7)
    assert files_in(folder) == files_in(tmp_path / "again")


@pytest.mark.parametrize(("name", "value"), [("size", 8), ("bands", 2), ("bands", 600), ("views", 3)])
def test_a_number_out_of_bounds_is_refused_before_anything_is_written(tmp_path, name, value):
    with pytest.raises(ConfigError, match=rf"--{name} of a demo scene must be \d+ to \d+; found {value}"):
        demo_scene.make_demo_scene(tmp_path / "scene", **{name: value})
    with pytest.raises(SpectrumError, match="there is no light 'D66'; nearest: D65"):
        demo_scene.make_demo_scene(tmp_path / "scene", size=16, bands=3, views=4, illuminant="D66")
    assert not list(tmp_path.iterdir())


def test_a_folder_with_something_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(ConfigError, match="is not empty"):
        demo_scene.make_demo_scene(tmp_path, size=16, bands=3, views=4)
    with pytest.raises(ConfigError, match="is a file"):
        demo_scene.make_demo_scene(tmp_path / "thesis.tex", overwrite=True)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("thesis.tex", "years")]


@pytest.mark.usefixtures("coarse")
def test_overwriting_replaces_the_older_scene_and_spares_other_files(tmp_path):
    directory = tmp_path / "scene"
    demo_scene.make_demo_scene(directory, size=16, bands=3, views=9)
    (directory / "notes.txt").write_text("mine")
    (directory / "images" / "mine.png").write_bytes(b"mine")
    demo_scene.make_demo_scene(directory, size=16, bands=4, views=4, overwrite=True)
    names = [f"{demo_scene.frame_name(index)}.npy" for index in range(4)]
    assert sorted(path.name for path in (directory / "cubes").glob("[!.]*")) == sorted(names)
    assert np.load(directory / "cubes" / "train_000.npy").shape == (16, 16, 4)
    assert (directory / "notes.txt").read_text() == "mine"
    assert (directory / "images" / "mine.png").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["scene"], "nothing temporary is left"


@pytest.mark.usefixtures("small_default")
@pytest.mark.parametrize("lost", [None, "transforms.json", "cubes/train_001.npy", "endmembers.csv"])
def test_the_cached_scene_is_written_once_unless_a_file_is_lost(tmp_path, lost):
    path = demo_scene.demo_scene_path(tmp_path)
    assert path.name == "demo", "a run is filed under the name of its scene"
    assert [p.name for p in path.parent.iterdir()] == ["demo"], "nothing temporary is left"
    stamp = (path / "endmembers.csv").stat().st_mtime_ns
    if lost is not None:
        (path / lost).unlink()
    assert demo_scene.is_complete(path) == (lost is None)
    assert demo_scene.demo_scene_path(tmp_path) == path
    assert demo_scene.is_complete(path)
    assert ((path / "endmembers.csv").stat().st_mtime_ns == stamp) == (lost is None)


@pytest.mark.usefixtures("small_default")
def test_the_cache_is_xdg_cache_home_if_that_is_absolute_else_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for set_to, where in ((str(tmp_path / "cache"), "cache"), ("relative", "home/.cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", set_to)
        assert demo_scene.demo_scene_path().is_relative_to(tmp_path / where / "unmix-nerf")


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ("285696 requested and 79808 written", "disk is full"),  # what numpy.save says
        ("encoder error -2 when writing image file", "the disk is full (encoder error -2"),
        ("cannot write mode F as PNG", ": cannot write mode F as PNG;"),
        (None, "unmix-demo-scene DIR"),  # a file where the folder should be
    ],
)
@pytest.mark.usefixtures("small_default")
def test_a_folder_that_cannot_be_written_is_told_with_a_way_out(tmp_path, monkeypatch, said, reason):
    def fail(*_):
        raise OSError(said)

    if said is None:
        (tmp_path / "cache").write_text("no folder")
    else:
        monkeypatch.setattr(np, "save", fail)
        with pytest.raises(SceneError, match=r"can't write the demo scene to .*make room") as refused:
            demo_scene.make_demo_scene(tmp_path / "scene", size=16, bands=4, views=4)
        assert reason in str(refused.value)
        assert list(tmp_path.iterdir()) == []
    with pytest.raises(SceneError, match="XDG_CACHE_HOME") as refused:
        demo_scene.demo_scene_path(tmp_path / "cache")
    assert reason in str(refused.value)


def test_without_a_home_folder_the_demo_scene_says_how_to_name_one(monkeypatch):
    def fail():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", fail)
    with pytest.raises(SceneError, match=r"no home folder .*set HOME or XDG_CACHE_HOME"):
        demo_scene.demo_scene_path()
