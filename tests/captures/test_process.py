"""From a folder of cubes to a scene that loads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.captures.capture_factory import (
    HEIGHT,
    WAVELENGTHS_NM,
    WIDTH,
    make_capture,
    process,
    write_cube,
    write_poses,
)
from tests.captures.poses.test_alignment import elsewhere
from unmix_plugin.captures import process as process_module
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.writing.view_files import FULL_SCALE
from unmix_plugin.scenes.reading.loader import load_scene


@pytest.mark.parametrize("kind", ["envi", "npy"])
def test_counts_become_reflectances_of_a_scene_that_loads(tmp_path: Path, kind):
    capture = make_capture(tmp_path / "capture", kind=kind)
    suffix = "hdr" if kind == "envi" else "npy"
    references = {name: capture.root / f"{name}.{suffix}" for name in ("white", "dark")}
    stated = {} if kind == "envi" else {"wavelengths": ",".join(map(str, WAVELENGTHS_NM))}

    process(capture.root, tmp_path / "scene", **references, **stated)

    scene = load_scene(tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, WAVELENGTHS_NM)
    assert [frame.name for frame in scene.frames] == sorted(capture.reflectance)
    for index, frame in enumerate(scene.frames):
        np.testing.assert_allclose(scene.cube(index), capture.reflectance[frame.name], atol=1.0 / 1000)
    record = json.loads((tmp_path / "scene" / "process.json").read_text())
    assert record["decisions"]["scale"]["calibrated"] == 1.0
    assert {Path(file["path"]).stem for file in record["references"]} == {"white", "dark"}


def test_background_is_cut_out_at_the_threshold_of_the_border(tmp_path: Path):
    capture = make_capture(tmp_path / "capture", noise=4.0)
    references = {name: capture.root / f"{name}.hdr" for name in ("white", "dark")}

    process(capture.root, tmp_path / "scene", mask="black", **references)

    scene = load_scene(tmp_path / "scene")
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[HEIGHT // 4 : HEIGHT // 4 + HEIGHT // 2, WIDTH // 4 : WIDTH // 4 + WIDTH // 2] = True
    for index in range(4):
        alpha = scene.alpha(index)
        assert alpha is not None
        np.testing.assert_array_equal(alpha > 0.5, expected)
        assert scene.cube(index)[~expected].max() == 0.0


def test_a_scene_with_estimated_poses_has_its_own_upright_world(tmp_path: Path, monkeypatch):
    capture = make_capture(tmp_path / "capture", views=12)
    tilted = elsewhere(read_poses(capture.root / "transforms.json"))
    cameras = {Path(name).stem: camera for name, camera in tilted.cameras.items()}
    estimated = replace(tilted, cameras=cameras, up=None, has_world=False)
    monkeypatch.setattr(process_module, "estimated_poses", lambda *_: estimated)

    process(capture.root, tmp_path / "scene", poses="estimate")

    scene = load_scene(tmp_path / "scene")
    written = read_poses(tmp_path / "scene" / "transforms.json").cameras
    model = scene.cameras.camera_to_world[:, :, 3].double().numpy()
    world = scene.normalisation.to_world(model)
    expected = [written[f"images/{frame.name}.png"].camera_to_world for frame in scene.frames]
    np.testing.assert_allclose(world, [pose[:, 3] for pose in expected], atol=1e-6)
    np.testing.assert_allclose([pose[2, 0] for pose in expected], 0.0, atol=1e-9)  # cameras stand upright
    assert min(pose[2, 1] for pose in expected) > 0.5


def test_crop_and_binning_move_the_lens_with_the_pixels(tmp_path: Path):
    capture = make_capture(tmp_path / "capture")
    process(capture.root, tmp_path / "scene", crop=(4, 6, 16, 20), bin_pixels=2, bin_bands=3)

    scene = load_scene(tmp_path / "scene")
    assert (scene.cameras.height, scene.cameras.width) == (8, 10)
    np.testing.assert_allclose(scene.cameras.focal_px[0], 1.5 * WIDTH / 2)
    np.testing.assert_allclose(scene.cameras.center_px[0], [(WIDTH / 2 - 6) / 2, (HEIGHT / 2 - 4) / 2])
    np.testing.assert_allclose(scene.wavelengths_nm, WAVELENGTHS_NM.reshape(3, 3).mean(axis=1))
    counts = np.fromfile(capture.root / "view_00.raw", "<u2").reshape(HEIGHT, len(WAVELENGTHS_NM), WIDTH)
    corner = counts[4:6, :3, 6:8].mean()
    record = json.loads((tmp_path / "scene" / "process.json").read_text())
    assert scene.cube(0)[0, 0, 0] == pytest.approx(
        corner / record["decisions"]["scale"]["calibrated"], abs=1e-4
    )


def test_saturated_pixels_are_written_as_one_and_missing_ones_are_masked(tmp_path: Path):
    capture = make_capture(tmp_path / "capture", views=2)
    counts = np.full((HEIGHT, WIDTH, len(WAVELENGTHS_NM)), 900, np.uint16)
    counts[:, ::3] += np.arange(HEIGHT, dtype=np.uint16)[:, None, None]
    counts[8:12, 8:12, 4] = 4095
    counts[20:22, :, :] = 7
    for name in ("view_00", "view_01"):
        write_cube(capture.root, name, counts, header={"data ignore value": 7})
    process(capture.root, tmp_path / "scene")

    scene = load_scene(tmp_path / "scene")
    assert (scene.cube(0)[8:12, 8:12, 4] == 1.0).all()
    assert scene.cube(0)[8:12, 8:12, 3].max() < 1.0
    expected = np.ones((HEIGHT, WIDTH), bool)
    expected[20:22] = False
    np.testing.assert_array_equal(scene.valid_mask(0), expected)
    record = json.loads((tmp_path / "scene" / "process.json").read_text())
    assert record["totals"]["saturated_pixels"] == 2 * 16
    assert record["totals"]["missing_pixels"] == 2 * 2 * WIDTH
    assert record["stored"]["value_scale"] == FULL_SCALE


def test_views_without_a_pose_are_left_out(tmp_path: Path):
    capture = make_capture(tmp_path / "capture")
    write_poses(capture.root / "transforms.json", ["view_00", "view_02", "view_03"])
    process(capture.root, tmp_path / "scene")
    assert [frame.name for frame in load_scene(tmp_path / "scene").frames] == [
        "view_00",
        "view_02",
        "view_03",
    ]


def test_pictures_become_linear_bands(tmp_path: Path):
    from PIL import Image

    root = tmp_path / "capture"
    root.mkdir()
    generator = np.random.default_rng(0)
    pixels = generator.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    for name in ("a", "b"):
        Image.fromarray(pixels).save(root / f"{name}.png")
    write_poses(root / "transforms.json", ["a", "b"])
    process(root, tmp_path / "scene", wavelengths="620,555,503")

    scene = load_scene(tmp_path / "scene")
    np.testing.assert_allclose(scene.wavelengths_nm, [503.0, 555.0, 620.0])
    encoded = pixels[..., ::-1] / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(scene.cube(0), linear, atol=1e-4)


def test_the_lamp_is_read_off_the_white_and_reflectances_are_seen_in_flat_light(tmp_path: Path):
    capture = make_capture(tmp_path / "capture")
    references = {name: capture.root / f"{name}.hdr" for name in ("white", "dark")}
    panel = np.linspace(0.5, 0.9, len(WAVELENGTHS_NM))
    rows = [
        f"{nm:g},{value:.6f}"
        for nm, value in zip(WAVELENGTHS_NM, panel, strict=True)  # its colour is not the lamp's
    ]
    (tmp_path / "panel.csv").write_text("\n".join(["wavelength,reflectance", *rows]))
    process(capture.root, tmp_path / "scene", white_reflectance=str(tmp_path / "panel.csv"), **references)

    lamp = capture.white.mean(axis=0) / panel
    written = np.loadtxt(tmp_path / "scene" / "illuminant.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(written[:, 1], lamp / lamp.max(), rtol=1e-4)
    scene = load_scene(tmp_path / "scene")
    np.testing.assert_array_equal(scene.illuminant, np.ones(len(WAVELENGTHS_NM)))
    np.testing.assert_allclose(scene.cube(0), capture.reflectance["view_00"] * panel, atol=1.0 / 1000)


def test_a_panel_in_a_view_serves_as_white(tmp_path: Path):
    capture = make_capture(tmp_path / "capture", views=2)
    counts = np.full((HEIGHT, WIDTH, len(WAVELENGTHS_NM)), 600, np.uint16)
    counts[4:10, 5:12] = 2400
    counts += np.random.default_rng(0).integers(
        0, 41, counts.shape, np.uint16
    )  # otherwise its top is a plateau
    write_cube(capture.root, "view_00", counts)
    process(
        capture.root, tmp_path / "scene", white_rectangle=("view_00", 4, 5, 6, 7), white_reflectance="0.5"
    )
    cube = load_scene(tmp_path / "scene").cube(0)
    white = counts[4:10, 5:12].mean(axis=(0, 1))
    np.testing.assert_allclose(cube, 0.5 * counts / white, atol=1e-4)


def test_what_was_done_is_written_for_people(tmp_path: Path):
    capture = make_capture(tmp_path / "capture")
    findings = process(capture.root, tmp_path / "scene", drop_bands="500-600")
    report = (tmp_path / "scene" / "report.txt").read_text()
    assert "bands left out: 500 nm, 550 nm, 600 nm (named in --drop-bands)" in report
    assert findings[0] == "only 4 views: expect holes and fog; 15 or more all around serve better"
    assert findings[0] in report
    assert (tmp_path / "scene" / "contact-sheet.png").read_bytes().startswith(b"\x89PNG")
    record = json.loads((tmp_path / "scene" / "process.json").read_text())
    assert record["what_looks_wrong"] == findings
    dropped = record["decisions"]["sensors"]["all views"]["dropped_bands"]
    assert [band["wavelength_nm"] for band in dropped] == [500.0, 550.0, 600.0]
