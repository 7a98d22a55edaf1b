"""What is in the files of a render: exactly what the model renders, whatever the format."""

from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image

from tests.factories.cubes import full_disk
from tests.factories.outputs import read_video
from tests.factories.refined_cameras import line_camera
from tests.factories.renders import SCENE, read_envi, read_exr, render, truth, views
from unmix_plugin.errors import RunError
from unmix_plugin.figures.pictures import CanvasLayout
from unmix_plugin.products.render.cameras import RenderCameras
from unmix_plugin.products.render.files import still_paths
from unmix_plugin.products.render.job import RenderJob, Survey, output_paths
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import TrainedScene

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")

COLOURS = endmember_colours(SCENE.materials)
NUMBERS = ["all", "band:550nm", "false-colour:650,550,450"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """All outputs of two views as numbers."""
    folder, cameras = tmp_path_factory.mktemp("numbers"), views()
    products, survey, _ = render(folder, NUMBERS, ["npy", "envi", "exr"], cameras)
    return folder, cameras, products, [truth(cameras, index, survey) for index in range(2)]


ENVI_NM = {
    "spectral": [450, 500, 550, 600, 650],
    "false-colour:650,550,450": [650, 550, 450],
    "band:550nm": [550],
    "abundances": [],
}


@pytest.mark.parametrize(("kind", "count"), [("npy", 22), ("envi", 21)])
def test_numbers_are_what_the_model_renders_bit_for_bit(written, kind, count):
    folder, cameras, products, expected = written
    chosen = [product for product in products if product.format == kind]
    assert len(chosen) == count
    for product in chosen:
        name = product.output.name
        for view, values in zip(cameras.views, expected, strict=True):
            wanted, paths = values[name], still_paths(folder, product, view.name)
            if kind == "npy":
                numbers = np.load(paths[0], allow_pickle=False)
                assert numbers.dtype == (np.uint8 if name == "segmentation" else np.float32)
            else:
                assert [path.name for path in paths] == [f"{view.name}.hdr", f"{view.name}.img"]
                numbers, metadata = read_envi(paths[0].with_suffix(""))
                assert str(metadata["description"]).startswith(name)
                if name in ENVI_NM:
                    assert [float(str(nm)) for nm in metadata.get("wavelength", [])] == ENVI_NM[name]
                if name == "abundances":
                    assert metadata["band names"] == list(SCENE.materials.names)
                wanted = wanted if wanted.ndim == 3 else wanted[..., None]
            np.testing.assert_array_equal(numbers, wanted)


def test_a_sweep_of_a_line_camera_is_rendered_by_the_poses_of_its_rows(tmp_path):
    """Block by block, and through a lens that bends."""
    lines = line_camera()
    cameras = RenderCameras((RunView("sweep", lines),), False, None)
    render(tmp_path, ["spectral"], ["npy"], cameras, pixels=5 * lines.width)
    expected = SCENE.look(lines)["spectral"].numpy()
    written = np.load(tmp_path / "spectral" / "sweep.npy")
    np.testing.assert_allclose(written, expected, atol=1e-5)
    still = SCENE.look(replace(lines, key_poses=None))["spectral"].numpy()
    assert np.abs(written - still).max() > 0.05


EXR_CHANNELS = {
    "spectral": [f"S0.{nm},000000nm" for nm in (450, 500, 550, 600, 650)],
    "linear_rgb": ["R", "G", "B"],
    "false-colour:650,550,450": ["R", "G", "B"],
    "depth": ["Z"],
    "accumulation": ["accumulation"],
    "band:550nm": ["band-550nm"],
    "normals": ["normals.X", "normals.Y", "normals.Z"],
    "abundances": [f"abundances.{name}" for name in SCENE.materials.names],
}


@pytest.mark.parametrize("name", EXR_CHANNELS)
def test_exr_channels_have_the_names_that_other_tools_expect(written, name):
    folder, _, products, expected = written
    product = next(one for one in products if one.output.name == name and one.format == "exr")
    read, values = read_exr(still_paths(folder, product, "view.1")[0]), expected[1]
    found = np.stack([read[channel] for channel in EXR_CHANNELS[name]], axis=-1)
    np.testing.assert_array_equal(found, values[name].reshape(11, 14, -1))
    others = set(read) - {"A"} - set(EXR_CHANNELS[name])
    assert others == ({"R", "G", "B"} if name == "spectral" else set())
    if name == "spectral":
        np.testing.assert_array_equal(read["A"], values["accumulation"])
        preview = np.stack([read[channel] for channel in "RGB"], axis=-1)
        np.testing.assert_allclose(preview, values["linear_rgb"], atol=1e-6)


def test_a_view_rendered_in_blocks_of_rows_is_the_view(tmp_path):
    cameras = views(1)
    outputs = ["spectral", "depth", "normals", "segmentation"]
    _, survey, job = render(tmp_path, outputs, ["npy", "envi", "exr", "png"], cameras, pixels=30)
    assert [block.camera.height for block in job.blocks(30)] == [2, 2, 2, 2, 2, 1]
    expected = truth(cameras, 0, survey)
    for name in ("spectral", "depth"):
        np.testing.assert_allclose(np.load(tmp_path / name / "view.0.npy"), expected[name], atol=1e-5)
    numbers, _ = read_envi(tmp_path / "spectral" / "view.0")
    np.testing.assert_allclose(numbers, expected["spectral"], atol=1e-5)
    np.testing.assert_allclose(read_exr(tmp_path / "depth" / "view.0.exr")["Z"], expected["depth"], atol=1e-5)
    with Image.open(tmp_path / "segmentation" / "view.0.png") as picture:
        assert (np.asarray(picture) == expected["segmentation"]).mean() > 0.98


def test_a_block_is_never_more_than_so_many_pixels_but_always_a_row(tmp_path):
    job = RenderJob(SCENE, views(1, width=300, height=200), (), Survey(), tmp_path)
    for pixels in (1, 299, 300, 1000, 10**6):
        heights = [block.camera.height for block in job.blocks(pixels)]
        assert sum(heights) == 200
        assert 300 * max(heights) <= max(300, pixels)
    assert all(block.camera.width * block.camera.height <= 1 << 16 for block in job.blocks())


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Pictures of three views, what they share, and what the scene itself renders of each."""
    folder, cameras = tmp_path_factory.mktemp("pictures"), views(3)
    outputs = ["rgb", "band:550nm", "depth", "segmentation", "abundances"]
    _, survey, _ = render(folder, outputs, ["png"], cameras)
    return folder, survey, [(f"view.{index}", truth(cameras, index, survey)) for index in range(3)]


def over_black(rgba):
    """Linear light that an RGBA picture adds to black."""
    encoded = rgba[..., :3] / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return linear * (rgba[..., 3:] / 255)


def test_pictures_have_straight_colours_and_the_models_opacity(pictures):
    folder, _, expected = pictures
    for name, values in expected:
        rgba = iio.imread(folder / "rgb" / f"{name}.png")
        assert np.abs(rgba[..., 3] - 255 * values["accumulation"]).max() <= 0.5001
        assert (values["accumulation"] < 0.9).any(), "the test needs transparent pixels"
        np.testing.assert_allclose(over_black(rgba), values["linear_rgb"], atol=0.006)
        grey = over_black(iio.imread(folder / "band-550nm" / f"{name}.png"))
        np.testing.assert_allclose(grey[..., 1], values["band:550nm"], atol=0.006)


def test_maps_have_one_known_range_and_ids_their_colours_in_all_views(pictures):
    folder, survey, expected = pictures
    low, high = survey.ranges["depth"]
    assert 0 < low < high
    for name, values in expected:
        with Image.open(folder / "depth" / f"{name}.png") as picture:
            assert f"viridis from {low:.6g} to {high:.6g}" in picture.info["Description"]
            rgba = np.asarray(picture)
        fraction = np.clip((values["depth"] - low) / (high - low), 0, 1)
        shown = rgba[..., 3] > 0
        colours = np.round(255 * colormaps["viridis"](fraction)[..., :3])
        np.testing.assert_allclose(rgba[shown][:, :3], colours[shown], atol=1)  # a half is rounded either way
        ids = values["segmentation"]
        with Image.open(folder / "segmentation" / f"{name}.png") as picture:
            np.testing.assert_array_equal(np.asarray(picture), ids)
            rgba = np.asarray(picture.convert("RGBA"))
        seen = ids != 255
        np.testing.assert_array_equal(rgba[seen][:, :3], np.round(255 * COLOURS[ids[seen]]))
        assert not rgba[~seen][:, 3].any()


def test_one_tile_for_each_endmember_stands_in_a_picture_of_abundances(pictures):
    folder, _, [(name, values), *_] = pictures
    rgba = iio.imread(folder / "abundances" / f"{name}.png")
    layout = CanvasLayout.of((14, 11), SCENE.materials.names)
    assert rgba.shape[1::-1] == layout.size
    shares = values["abundances"] / np.maximum(values["accumulation"], 1e-6)[..., None]
    for index in range(3):
        left = layout.corner(index)[1]
        tile = rgba[-11:, left : left + 14]
        colours = np.round(255 * colormaps["viridis"](np.clip(shares[..., index], 0, 1))[..., :3])
        shown = tile[..., 3] > 0
        np.testing.assert_array_equal(tile[shown][:, :3], colours[shown])
        swatch = rgba[8, left + 6, :3]
        np.testing.assert_array_equal(swatch, np.round(255 * COLOURS[index]))


def test_a_moving_camera_makes_one_video_with_a_frame_a_view(tmp_path):
    cameras = views(4, is_path=True)
    outputs = ["rgb", "pca", "segmentation", "abundances"]
    products, _, _ = render(tmp_path, outputs, ["mp4"], cameras)
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == sorted(f"{name}.mp4" for name in outputs)
    for product in products:
        frames, facts = read_video(output_paths(tmp_path, product, cameras)[0])
        assert len(frames) == 4
        assert facts["fps"] == 24.0
        assert np.abs(np.diff(frames.astype(float), axis=0)).mean() > 0.5, "the camera moves"


def test_a_sweep_shows_band_after_band_from_one_camera_or_from_a_moving_one(tmp_path):
    cameras = views(2, width=60, height=28)
    _, survey, _ = render(tmp_path, ["spectral"], ["mp4"], cameras)
    frames, facts = read_video(tmp_path / "spectral" / "view.1.mp4")
    assert frames.shape == (5, 28 + 18, 60, 3)
    assert facts["fps"] == 4.0
    expected = truth(cameras, 1, survey)
    grey = ((0.92 + 0.055) / 1.055) ** 2.4
    for band in range(5):
        light = np.clip(expected["spectral"][..., band] + grey * (1 - expected["accumulation"]), 0, 1)
        encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        seen = frames[band, 18:].mean(axis=-1)
        assert np.abs(seen - 255 * encoded).max() < 25
        assert np.abs(seen - 255 * encoded).mean() < 3
    render(tmp_path / "path", ["spectral"], ["mp4"], views(3, is_path=True, width=52, height=10))
    frames, _ = read_video(tmp_path / "path" / "spectral.mp4")
    assert frames.shape == (3, 10 + 18, 52, 3)
    captions = frames[:, :18].astype(int)
    assert np.abs(captions[0] - captions[-1]).max() >= 80  # the wavelength that each frame shows


@pytest.mark.parametrize("after", [0, 5000, 9000])
def test_a_disk_that_fills_up_leaves_whole_files_only(tmp_path, monkeypatch, after):
    cameras = views(2)
    full_disk(monkeypatch, after)
    with pytest.raises(RunError, match=r"can't write .*view\.\d.*: No space left on device; make room"):
        render(tmp_path, ["spectral", "rgb"], ["npy", "envi", "png"], cameras, pixels=30)
    whole = 128 + 11 * 14 * 5 * 4
    for path in tmp_path.rglob("*"):
        assert not path.name.endswith(".tmp")
        if path.suffix == ".npy" and path.parent.name == "spectral":
            assert path.stat().st_size == whole
        if path.suffix == ".png":
            iio.imread(path)


def test_an_error_while_rendering_leaves_no_video(tmp_path, monkeypatch):
    cameras = views(3, is_path=True)

    def failing(scene, camera, subpixels=None, look=TrainedScene.look):
        if camera is not first and camera.camera_to_world.equal(last):
            raise KeyboardInterrupt
        return look(scene, camera, subpixels)

    first, last = cameras.views[0].camera, cameras.views[2].camera.camera_to_world
    monkeypatch.setattr(TrainedScene, "look", failing)
    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, ["rgb", "accumulation"], ["mp4"], cameras)
    assert list(tmp_path.iterdir()) == []


INDEX = "index:(r650-r500)/(r650+r500)"


@pytest.mark.parametrize("pixels", [None, 30])
def test_indices_and_targets_are_those_of_the_rendered_spectra_in_every_block(tmp_path, pixels):
    target = tmp_path / "paint.csv"
    target.write_text("wavelength,paint\n450,0.1\n650,0.9\n")
    cameras = views()
    matched, angle = f"target:mf:{target}", f"target:{target}"
    products, survey, _ = render(tmp_path, [INDEX, matched, angle, "spectral"], ["npy"], cameras, pixels)
    read = {one.output.name: np.load(still_paths(tmp_path, one, "view.0")[0]) for one in products}
    seen = SCENE.look(cameras.views[0].camera).opacity.numpy() >= 0.5
    spectra = read["spectral"]
    expected = (spectra[..., 4] - spectra[..., 1]) / (spectra[..., 4] + spectra[..., 1])
    np.testing.assert_allclose(read[INDEX][seen], expected[seen], rtol=1e-4, atol=1e-6)
    assert np.isnan(read[INDEX][~seen]).all()
    direction = np.interp([450, 500, 550, 600, 650], [450, 650], [0.1, 0.9])
    cosine = spectra @ direction / (np.linalg.norm(spectra, axis=-1) * np.linalg.norm(direction) + 1e-12)
    np.testing.assert_allclose(read[angle][seen], np.arccos(np.clip(cosine[seen], -1, 1)), atol=1e-3)
    assert np.isfinite(read[matched][seen]).all()
    assert set(survey.outputs) == {INDEX, matched, angle}


def test_scores_of_ace_are_shown_over_the_range_that_they_have(tmp_path):
    target = tmp_path / "paint.csv"
    target.write_text("wavelength,paint\n450,0.1\n650,0.9\n")
    cameras, coherence = views(), f"target:ace:{target}"
    products, survey, _ = render(tmp_path, [coherence], ["npy"], cameras)
    values = np.stack([np.load(still_paths(tmp_path, products[0], one.name)[0]) for one in cameras.views])
    low, high = np.nanquantile(values, [0.01, 0.99])
    shown = survey.ranges[coherence]
    assert shown[0] == pytest.approx(low, abs=0.1 * (high - low))
    assert shown[1] == pytest.approx(high, abs=0.1 * (high - low))
