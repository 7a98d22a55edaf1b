"""From a capture to a scene that loads; going on after a start that was cut off; what a user is told of pictures."""

from __future__ import annotations

import hashlib
import json
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock
from PIL import Image

from tests.factories.captures import (
    BANDS,
    HEIGHT,
    WAVELENGTHS_NM,
    WIDTH,
    make_capture,
    process,
    write_cube,
    write_poses,
)
from tests.factories.files import present
from unmix_plugin.captures import process as process_module
from unmix_plugin.captures.cube import ReadOptions
from unmix_plugin.captures.layouts.cubes import find_cubes
from unmix_plugin.captures.wavelengths import parse_bands
from unmix_plugin.captures.writing.view_files import FULL_SCALE, write_view
from unmix_plugin.engine.runs.replacing import LIST_NAME
from unmix_plugin.errors import CaptureError, ConfigError, RunError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.spectral.materials import seen_reflectance


@pytest.fixture
def capture(tmp_path: Path):
    """Of four views, in ENVI files."""
    return make_capture(tmp_path / "capture")


def references_of(capture, suffix: str = "hdr") -> dict[str, Path]:
    return {name: capture.root / f"{name}.{suffix}" for name in ("white", "dark")}


def counts_of(path: Path) -> np.ndarray:
    """Of a cube that the factory wrote, (H, W, B)."""
    return np.fromfile(path, "<u2").reshape(-1, BANDS, WIDTH).transpose(0, 2, 1)


def made(tmp_path: Path, capture, **options):
    """The scene of a capture, and what looks wrong."""
    findings = process(capture.root, tmp_path / "scene", **options)
    return load_scene(tmp_path / "scene"), findings


def scale_of(scene: Path) -> float:
    return record_of(scene)["plan"]["scale"]["calibrated"]


def record_of(scene: Path):
    return json.loads((scene / "process.json").read_text())


@pytest.mark.parametrize("kind", ["envi", "npy"])
def test_counts_become_reflectances_of_a_scene_that_loads(tmp_path: Path, kind):
    capture = make_capture(tmp_path / "capture", kind=kind)
    stated = {} if kind == "envi" else {"wavelengths": ",".join(map(str, WAVELENGTHS_NM))}
    scene, _ = made(tmp_path, capture, **references_of(capture, "hdr" if kind == "envi" else "npy"), **stated)
    np.testing.assert_allclose(scene.wavelengths_nm, WAVELENGTHS_NM)
    assert [frame.name for frame in scene.frames] == sorted(capture.reflectance)
    for index, frame in enumerate(scene.frames):
        np.testing.assert_allclose(scene.cube(index), capture.reflectance[frame.name], atol=1.0 / 1000)
    record = record_of(tmp_path / "scene")
    assert scale_of(tmp_path / "scene") == 1.0
    assert {Path(file["path"]).stem for file in record["references"]} == {"white", "dark"}
    for source in (source for view in record["views"] for source in view["sources"]):
        data = Path(source["path"]).read_bytes()
        assert (source["sha256"], source["bytes"]) == (hashlib.sha256(data).hexdigest(), len(data))


@pytest.mark.parametrize("suffix", ["hdr", "raw"])
def test_a_reference_of_any_name_is_no_view_by_whichever_of_its_files_it_is_named(tmp_path, capture, suffix):
    for path in capture.root.glob("white.*"):
        path.rename(path.with_stem("spectralon"))
    told: list[str] = []
    white = capture.root / f"spectralon.{suffix}"
    process(capture.root, tmp_path / "scene", "cubes", told.append, white=white)
    assert told[0] == f"{capture.root}: 4 views of the layout cubes"


@pytest.mark.parametrize(("reflectance", "is_said"), [("1", False), ("0.5", True)])
def test_values_that_saturate_far_below_1_are_said_to_be_written_as_it(
    tmp_path, capture, reflectance, is_said
):
    for name in capture.reflectance:
        counts = counts_of(capture.root / f"{name}.raw").copy()
        counts[8:14, 8:14] = 4095
        write_cube(capture.root, name, counts)
    _, findings = made(tmp_path, capture, **references_of(capture), white_reflectance=reflectance)
    assert any("values are saturated from 0." in finding for finding in findings) == is_said


@pytest.mark.parametrize(("scale", "said"), [(100.0, "is too low: "), (4095.0, ""), (1e7, "is too high: ")])
def test_a_given_scale_that_must_be_wrong_is_said(tmp_path, capture, scale, said):
    _, findings = made(tmp_path, capture, scale=scale)
    assert [said in line for line in findings if line.startswith("--scale")] == [True] * bool(said)


def test_poses_in_an_array_beside_the_cubes_are_no_view(tmp_path: Path, capture):
    frames = json.loads((capture.root / "transforms.json").read_text())["frames"]
    matrices = np.array([frame["transform_matrix"] for frame in frames])[:, :3]
    axes = [-matrices[..., 1], matrices[..., 0], matrices[..., 2], matrices[..., 3]]
    sizes = np.broadcast_to([HEIGHT, WIDTH, 1.5 * WIDTH], (len(frames), 3))
    table = np.stack([*axes, sizes], axis=-1).reshape(len(frames), 15)
    np.save(capture.root / "poses_bounds.npy", np.hstack([table, np.ones((len(frames), 2))]))
    scene, _ = made(tmp_path, capture, poses="poses_bounds.npy")
    assert [frame.name for frame in scene.frames] == sorted(capture.reflectance)


BRIGHT_SQUARE = np.zeros((HEIGHT, WIDTH), bool)
BRIGHT_SQUARE[HEIGHT // 4 : 3 * HEIGHT // 4, WIDTH // 4 : 3 * WIDTH // 4] = True


def test_crop_and_binning_move_the_lens_with_the_pixels(tmp_path: Path, capture):
    scene, _ = made(tmp_path, capture, crop=(4, 6, 16, 20), bin_pixels=2, bin_bands=3)
    assert (scene.cameras.height, scene.cameras.width) == (8, 10)
    np.testing.assert_allclose(scene.cameras.focal_px[0], 1.5 * WIDTH / 2)
    np.testing.assert_allclose(scene.cameras.center_px[0], [(WIDTH / 2 - 6) / 2, (HEIGHT / 2 - 4) / 2])
    np.testing.assert_allclose(scene.wavelengths_nm, WAVELENGTHS_NM.reshape(3, 3).mean(axis=1))
    square = counts_of(capture.root / "view_00.raw")[4:6, 6:8, :3]
    assert scene.cube(0)[0, 0, 0] == pytest.approx(square.mean() / scale_of(tmp_path / "scene"), abs=1e-4)


def test_saturated_pixels_are_written_as_one_and_missing_ones_are_masked(tmp_path: Path):
    capture = make_capture(tmp_path / "capture", views=2)
    counts = np.full((HEIGHT, WIDTH, BANDS), 900, np.uint16)
    counts[:, ::3] += np.arange(HEIGHT, dtype=np.uint16)[:, None, None]
    counts[8:12, 8:12, 4] = 4095
    counts[20:22, :, :] = 7
    for name in capture.reflectance:
        write_cube(capture.root, name, counts, header={"data ignore value": 7})
    scene, _ = made(tmp_path, capture)
    assert (scene.cube(0)[8:12, 8:12, 4] == 1.0).all()
    assert scene.cube(0)[8:12, 8:12, 3].max() < 1.0
    np.testing.assert_array_equal(scene.valid_mask(0), (counts != 7).all(axis=-1))
    totals = record_of(tmp_path / "scene")["totals"]
    assert (totals["saturated_pixels"], totals["missing_pixels"]) == (2 * 16, 2 * 2 * WIDTH)
    assert record_of(tmp_path / "scene")["stored"]["value_scale"] == FULL_SCALE


def test_a_band_that_one_view_marks_as_bad_is_left_out_and_byte_orders_may_differ(tmp_path: Path, capture):
    counts = counts_of(capture.root / "view_01.raw")
    marks = {"byte order": 1, "bbl": "{1, 1, 1, 0, 1, 1, 1, 1, 1}"}
    write_cube(capture.root, "view_01", counts.astype(">u2"), header=marks)
    scene, _ = made(tmp_path, capture, scale=4095.0)
    np.testing.assert_array_equal(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 3))
    np.testing.assert_allclose(scene.cube(1), np.delete(counts, 3, axis=2) / 4095, atol=1e-4)


def test_bands_in_which_the_white_is_saturated_are_left_out_and_said(tmp_path: Path, capture):
    white = counts_of(capture.root / "white.raw").copy()
    white[..., 2] = 4095  # which no view reaches
    write_cube(capture.root, "white", white)
    scene, findings = made(tmp_path, capture, **references_of(capture))
    assert findings[0].startswith("white.hdr: the white is saturated in 550 nm: these bands are left out")
    np.testing.assert_array_equal(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 2))
    expected = np.delete(capture.reflectance["view_00"], 2, axis=2)
    np.testing.assert_allclose(scene.cube(0), expected, atol=1.0 / 1000)


def test_a_band_that_the_white_marks_as_bad_is_left_out(tmp_path: Path, capture):
    marks = {"bbl": "{1, 1, 1, 0, 1, 1, 1, 1, 1}"}
    write_cube(capture.root, "white", counts_of(capture.root / "white.raw"), header=marks)
    scene, _ = made(tmp_path, capture, **references_of(capture))
    np.testing.assert_array_equal(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 3))


@pytest.mark.parametrize("is_marked", [True, False])
@pytest.mark.parametrize("name", ["white", "dark"])
def test_a_reference_that_measured_nothing_in_a_band_serves_in_the_others(tmp_path, capture, name, is_marked):
    counts = counts_of(capture.root / f"{name}.raw").copy()
    counts[..., 3] = 65535
    marks = {"bbl": "{1, 1, 1, 0, 1, 1, 1, 1, 1}"} if is_marked else {}
    write_cube(capture.root, name, counts, header={"data ignore value": 65535, **marks})
    scene, findings = made(tmp_path, capture, **references_of(capture))
    np.testing.assert_array_equal(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 3))
    expected = np.delete(capture.reflectance["view_00"], 3, axis=2)
    np.testing.assert_allclose(scene.cube(0), expected, atol=1.0 / 1000)
    said = f"{name}.hdr: nothing was measured in {WAVELENGTHS_NM[3]:g} nm (NaN or no-data): these bands are left out"
    assert (said in findings) == (not is_marked)
    reason = f"marked as bad in the {name}" if is_marked else "a reference measured nothing there"
    assert reason in (tmp_path / "scene" / "report.txt").read_text()


def test_a_panel_in_views_with_an_unmeasured_bad_band_serves_in_the_others(tmp_path, capture):
    marks = {"data ignore value": 65535, "bbl": "{1, 1, 1, 0, 1, 1, 1, 1, 1}"}
    for name in capture.reflectance:
        counts = counts_of(capture.root / f"{name}.raw").copy()
        counts[2:6, 2:6] = np.random.default_rng(0).integers(3000, 3100, (4, 4, BANDS))
        counts[..., 3] = 65535
        write_cube(capture.root, name, counts, header=marks)
    rectangle = ("view_00", 2, 2, 4, 4)
    scene, _ = made(tmp_path, capture, white_rectangle=rectangle, dark=capture.root / "dark.hdr", scale=1.0)
    np.testing.assert_array_equal(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 3))
    np.testing.assert_allclose(scene.cube(0)[2:6, 2:6], 1.0, atol=0.05)


@pytest.mark.parametrize("has_file", [False, True])
def test_dark_lines_of_a_file_are_its_dark_frame_where_it_has_no_other(tmp_path, capture, has_file: bool):
    """Specim's line cameras close the shutter for the last lines; poses and masks may be made for all of them."""

    def write(name, light, level, shut):
        lines = [light + level, np.broadcast_to(500 if has_file else shut, (6, *light.shape[1:]))]
        counts = np.concatenate(lines).round().astype(np.uint16)
        write_cube(capture.root, name, counts, header={"autodarkstartline": len(light)})

    for index, (name, reflectance) in enumerate(capture.reflectance.items()):
        level = capture.dark if has_file else capture.dark + 40 * index  # which drifts from view to view
        write(name, reflectance * capture.white, level, level)
        Image.new("RGBA", (WIDTH, HEIGHT + 6 * has_file), (9, 9, 9, 255)).save(capture.root / f"{name}.png")
    level = capture.dark if has_file else 200
    write("white", np.tile(capture.white, (12, 1, 1)), level, level)
    write_poses(capture.root / "transforms.json", list(capture.reflectance), height=HEIGHT + 6)
    references = references_of(capture) if has_file else {"white": capture.root / "white.hdr"}
    scene, _ = made(tmp_path, capture, mask="files", **references)
    for index, reflectance in enumerate(capture.reflectance.values()):
        np.testing.assert_allclose(scene.cube(index), reflectance, atol=1e-3)
    assert (scene.cameras.width, scene.cameras.height) == (WIDTH, HEIGHT)
    assert scene.cameras.center_px[0, 1] == (HEIGHT + 6) / 2


def test_reflectances_that_are_divided_are_said_to_be(tmp_path: Path, capture):
    stated = references_of(capture) | {"white_reflectance": "0.02"}
    findings = process(capture.root, tmp_path / "scene", **stated)
    scale = scale_of(tmp_path / "scene")
    assert scale != 1
    why = "nearly all are below 0.05 (was the white exposed and lit as the views were?)"
    assert findings[0].startswith(f"values (reflectance) were divided by {scale:g}, as {why}: ")
    said = process(capture.root, tmp_path / "kept", **stated, scale=1.0)
    for name, values in capture.reflectance.items():  # numbers whose meaning nobody stated
        write_cube(capture.root, name, (900 * values).astype(np.float32))
    said += process(capture.root, tmp_path / "unstated")
    assert not any("divided by" in finding for finding in said)
    assert scale_of(tmp_path / "unstated") > 1


def test_views_come_in_the_order_of_their_numbers_and_those_without_a_pose_are_left_out(tmp_path, capture):
    """Ranges of --angles, and neighbours among many views, go by it."""
    names = ["turn_9", "turn_10", "turn_11", "turn_12"]
    for old, new in zip(capture.reflectance, names, strict=True):
        for suffix in ("hdr", "raw"):
            (capture.root / f"{old}.{suffix}").rename(capture.root / f"{new}.{suffix}")
    assert [view.name for view in find_cubes(capture.root, ReadOptions()).views] == names
    write_poses(capture.root / "transforms.json", names[:3])
    assert [frame.name for frame in made(tmp_path, capture)[0].frames] == names[:3]


def test_the_lamp_is_read_off_the_white_and_reflectances_are_seen_in_flat_light(tmp_path: Path, capture):
    panel = np.linspace(0.5, 0.9, len(WAVELENGTHS_NM))  # of another colour
    rows = [f"{nm:g},{value:.6f}" for nm, value in zip(WAVELENGTHS_NM, panel, strict=True)]
    (tmp_path / "panel.csv").write_text("\n".join(["wavelength,reflectance", *rows]))
    stated = references_of(capture) | {"white_reflectance": str(tmp_path / "panel.csv")}
    scene, _ = made(tmp_path, capture, **stated)
    lamp = capture.white.mean(axis=0) / panel
    written = np.loadtxt(tmp_path / "scene" / "illuminant.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(written[:, 1], lamp / lamp.max(), rtol=1e-4)
    np.testing.assert_array_equal(scene.illuminant, np.ones(len(WAVELENGTHS_NM)))
    np.testing.assert_allclose(scene.cube(0), capture.reflectance["view_00"] * panel, atol=1.0 / 1000)


@pytest.mark.parametrize("scale", [0.5, 2.5])
def test_reflectance_is_what_was_measured_whatever_it_was_divided_by(tmp_path: Path, capture, scale):
    scene, _ = made(tmp_path, capture, **references_of(capture), scale=scale)
    expected = capture.reflectance["view_00"]
    stored = torch.from_numpy(scene.cube(0)).double()
    light = torch.from_numpy(present(scene.illuminant))
    found = seen_reflectance(stored, torch.ones(stored.shape[:2]), light).numpy()
    assert (expected > scale).any() == (scale < 1)  # what lies above the scale is cut off
    np.testing.assert_allclose(found, expected.clip(max=scale), atol=2e-3 * scale)


@pytest.mark.parametrize(
    ("name", "top", "dtype", "header", "unit", "is_known"),
    [
        ("leaf_{}", 1e4, np.uint16, {"reflectance scale factor": 10000}, "reflectance, as header", True),
        ("REFLECTANCE_{}", 1, np.float32, {}, "reflectance, as the name REFLECTANCE_0 says", True),
        ("REFLECTANCE_{}", 100, np.float32, {}, "reflectance, as the name", False),  # per cent
        ("REFLECTANCE_{}", 4000, np.uint16, {}, "relative radiance", False),  # raw
        ("leaf_{}", 1, np.float32, {"data gain values": 0.5}, "stored numbers divided", False),
        ("leaf_{}", 1, np.float32, {}, "relative radiance", False),
    ],
)
def test_reflectances_that_files_hold_are_seen_in_flat_light_if_a_white_is_1(
    tmp_path: Path, capture, name, top, dtype, header, unit, is_known
):
    for path in capture.root.glob("*.*"):
        path.unlink()
    names = [name.format(index) for index in range(len(capture.reflectance))]
    for view, values in zip(names, capture.reflectance.values(), strict=True):
        write_cube(capture.root, view, (values * top).astype(dtype), header=header)
    write_poses(capture.root / "transforms.json", names)
    scene, _ = made(tmp_path, capture)
    [found] = [each for each in record_of(tmp_path / "scene")["decisions"] if each["subject"] == "values"]
    assert found["outcome"].startswith(unit)
    assert (scene.illuminant is not None) == is_known
    if is_known:
        np.testing.assert_array_equal(scene.illuminant, np.ones(len(WAVELENGTHS_NM)))
        np.testing.assert_allclose(scene.cube(0), capture.reflectance["view_00"], atol=1e-3)


def test_what_was_done_is_written_for_people(tmp_path: Path, capture):
    _, findings = made(tmp_path, capture, drop_bands="500-600")
    report = (tmp_path / "scene" / "report.txt").read_text()
    assert "named in --drop-bands (500 nm, 550 nm, 600 nm)" in report
    assert findings[0] == "only 4 views: expect holes and fog; 15 or more all around serve better"
    assert findings[0] in report
    record = record_of(tmp_path / "scene")
    assert record["what_looks_wrong"] == findings
    dropped = record["plan"]["sensors"]["all views"]["dropped_bands"]
    assert [band["wavelength_nm"] for band in dropped] == [500.0, 550.0, 600.0]


class _Writer:
    """Writes views and counts them; stops at one of them in the way of a kill."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at, self.written = stop_at, []

    def __call__(self, view, recipe, folder, resampling=None):
        if len(self.written) == self.stop_at:
            raise KeyboardInterrupt
        self.written.append(view.name)
        return write_view(view, recipe, folder, resampling)


@pytest.fixture
def interrupted(tmp_path: Path, capture, monkeypatch: pytest.MonkeyPatch):
    """A capture of which 2 views are written."""
    monkeypatch.setattr(process_module, "write_view", _Writer(stop_at=2))
    with pytest.raises(KeyboardInterrupt):
        process(capture.root, tmp_path / "scene")
    return capture


@pytest.fixture
def writer(interrupted, monkeypatch: pytest.MonkeyPatch) -> _Writer:  # noqa: ARG001 - after the first start
    writer = _Writer()
    monkeypatch.setattr(process_module, "write_view", writer)
    return writer


def test_two_processes_do_not_write_one_scene(interrupted, writer, tmp_path: Path):
    with FileLock(tmp_path / "scene.unfinished" / "process.lock"):
        with pytest.raises(RunError, match="another unmix-process writes to"):
            process(interrupted.root, tmp_path / "scene")
        assert writer.written == []
    process(interrupted.root, tmp_path / "scene")
    assert not (tmp_path / "scene" / "process.lock").exists()


def test_the_next_start_goes_on_with_the_next_view(interrupted, writer, tmp_path: Path):
    """A record that was changed is somebody's, and refused; one that is gone is written again."""
    unfinished = tmp_path / "scene.unfinished"
    assert not (tmp_path / "scene").exists()
    assert len(list((unfinished / "cubes").glob("*.npy"))) == 2
    assert not (unfinished / "transforms.json").exists()
    (unfinished / "views" / "view_00.json").write_text('{"name": "view')
    with pytest.raises(ConfigError, match=r"view_00\.json is in the way"):
        process(interrupted.root, tmp_path / "scene")
    (unfinished / "views" / "view_00.json").unlink()
    process(interrupted.root, tmp_path / "scene")
    assert writer.written == ["view_00", "view_02", "view_03"]
    assert not unfinished.exists()
    process(interrupted.root, tmp_path / "whole")
    for path in sorted((tmp_path / "whole").rglob("*")):
        if path.is_file() and path.name not in ("process.json", LIST_NAME):
            mine = tmp_path / "scene" / path.relative_to(tmp_path / "whole")
            assert mine.read_bytes() == path.read_bytes()
    assert len(load_scene(tmp_path / "scene").frames) == 4


def test_a_library_that_poses_need_is_asked_for_before_any_view_is_written(
    interrupted, writer, tmp_path: Path, monkeypatch
):
    monkeypatch.setattr("importlib.util.find_spec", {}.get)
    with pytest.raises(CaptureError, match='pycolmap is not installed: python -m pip install "opencv'):
        process(interrupted.root, tmp_path / "new", poses="estimate")
    assert writer.written == []


@pytest.mark.parametrize("options", [{"bin_bands": 3}, {}], ids=["options", "input"])
def test_other_options_or_inputs_start_again(interrupted, writer, tmp_path: Path, options):
    if not options:
        numbers = np.fromfile(interrupted.root / "view_03.raw", "<u2")
        numbers[5] += 1
        numbers.tofile(interrupted.root / "view_03.raw")
    process(interrupted.root, tmp_path / "scene", **options)
    assert len(writer.written) == 4


@pytest.mark.parametrize("changed", ["panel", "wavelengths", "scale"])
def test_numbers_that_are_mended_in_a_table_start_again(tmp_path: Path, monkeypatch, changed):
    """Those beside the capture that options name, and those in its transforms.json."""
    capture = make_capture(tmp_path / "capture", kind="npy")
    panel, wavelengths, listed = tmp_path / "panel.csv", tmp_path / "nm.csv", capture.root / "transforms.json"
    layout, options = "unmix-nerf" if changed == "scale" else "cubes", {"mask": "none"}
    content = json.loads(listed.read_text()) | {"wavelengths": WAVELENGTHS_NM.tolist()}
    for name, frame in zip(capture.reflectance, content["frames"], strict=True):
        frame["hyperspectral_file_path"] = f"{name}.npy"
    if changed != "scale":
        named = {"white_reflectance": str(panel), "wavelengths": str(wavelengths)}
        options |= references_of(capture, "npy") | named

    def start(wrong: str, stop_at: int | None = None) -> list[str]:
        """What is written with numbers of which one is wrong."""
        listed.write_text(json.dumps(content | {"value_scale": 6000 if wrong == "scale" else 8000}))
        panel.write_text(f"wavelength,panel\n400,{0.5 if wrong == 'panel' else 0.99}\n900,0.99")
        centres = WAVELENGTHS_NM[:: -1 if wrong == "wavelengths" else 1]
        wavelengths.write_text("\n".join(["wavelength", *map(str, centres)]))
        writer = _Writer(stop_at)
        monkeypatch.setattr(process_module, "write_view", writer)
        with suppress(KeyboardInterrupt):
            process(capture.root, tmp_path / "scene", layout, **options)
        return writer.written

    assert (len(start(changed, stop_at=2)), len(start(""))) == (2, 4)
    hashed = {Path(file["path"]) for file in record_of(tmp_path / "scene")["references"]}
    assert {panel, wavelengths} <= hashed or changed == "scale"


def test_a_scene_is_replaced_only_if_asked(tmp_path: Path, capture):
    process(capture.root, tmp_path / "scene")
    with pytest.raises(ConfigError, match=r"holds a scene already.*--overwrite"):
        process(capture.root, tmp_path / "scene")
    process(capture.root, tmp_path / "scene", overwrite=True, bin_bands=3)
    assert len(load_scene(tmp_path / "scene").wavelengths_nm) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "scene"]


def test_a_scene_may_be_written_to_the_working_directory_but_not_to_the_root(tmp_path, capture, monkeypatch):
    (tmp_path / "scene").mkdir()
    monkeypatch.chdir(tmp_path / "scene")
    process(capture.root, Path())
    assert (tmp_path / "scene" / "transforms.json").is_file()
    with pytest.raises(ConfigError, match="can't be a scene"):
        process(capture.root, Path("/"))


@pytest.mark.parametrize(
    ("text", "nm"),
    [
        ("450.5\n460.5\n", [450.5, 460.5]),
        ("450,\n460,\n", [450, 460]),
        ("450,460,470\n", [450, 460, 470]),
        ("wavelength,width\n450,5\n460,5\n", [450, 460]),
        ("wavelength\n450,5\n460,5\n", [450.5, 460.5]),
        ("band;wavelength [\u00b5m];name\n1;0,45;blue\n2;0,55;green\n", [450, 550]),
        ("450,5\n460,5\n", "can be read in two ways: 450 and 5 with .* or 450.5 with"),
        ("1 450\n2 460\n", "the line '1 450' has 2 cells; expected one number a line"),
    ],
)
def test_a_file_of_wavelengths_has_one_a_line_or_a_header(tmp_path: Path, text, nm):
    (tmp_path / "nm.csv").write_text(text)
    if isinstance(nm, str):
        with pytest.raises(ConfigError, match=nm):
            parse_bands(str(tmp_path / "nm.csv"))
    else:
        assert parse_bands(str(tmp_path / "nm.csv")).wavelengths_nm == pytest.approx(nm)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("wavelength,fwhm\n450,5\n460,6\n", [5, 6]),
        ("wavelength (um);FWHM (nm)\n0,45;5\n0,46;6\n", [5, 6]),
        ("wavelength [um],band_width\n0.45,0.005\n0.46,0.006\n", [5, 6]),
        ("band,wavelength,bandwidth_um\n1,450,0.005\n2,460,0.006\n", [5, 6]),
        ("wavelength,fwhm\nnm,um\n450,0.005\n460,0.006\n", [5, 6]),
        ("wavelength,fwhm\n450,0.005\n460,0.006\n", [5, 6]),
        ("wavelength,450,460\nfwhm,5,6\n", [5, 6]),
        ("wavelength,name\n450,blue\n460,cyan\n", None),
        ("wavelength,fwhm\n450,5\n460,\n", "the width at 460 nm is nan"),
        ("wavelength,fwhm\n450,0\n460,5\n", "the width at 450 nm is 0"),
        ("wavelength,fwhm\n450,5000\n460,5000\n", "widths of bands 5000 to 5000 nm"),
        ("wavelength,fwhm (px)\n450,2\n460,2\n", "widths of bands in 'px'"),
        ("wavelength,fwhm,bandwidth\n450,5,7\n460,5,7\n", "the columns 'fwhm' and 'bandwidth'"),
        ("wavelength,bbl\n450,1\n460,2\n", "marks of good bands"),
    ],
)
def test_widths_beside_wavelengths_are_those_of_the_bands_or_refused(tmp_path: Path, text, expected):
    (tmp_path / "nm.csv").write_text(text)
    if isinstance(expected, str):
        with pytest.raises(ConfigError, match=expected):
            parse_bands(str(tmp_path / "nm.csv"))
        return
    found = parse_bands(str(tmp_path / "nm.csv"))
    assert found.wavelengths_nm == pytest.approx([450, 460])
    assert found.fwhm_nm == (None if expected is None else pytest.approx(expected))


def test_given_widths_and_marks_of_bad_bands_come_into_the_scene(tmp_path: Path):
    capture = make_capture(tmp_path / "capture", kind="npy")
    rows = [f"{nm},{nm / 50},{int(band != 3)}" for band, nm in enumerate(WAVELENGTHS_NM)]
    (tmp_path / "nm.csv").write_text("\n".join(["wavelength,fwhm,bbl", *rows]))
    scene, _ = made(tmp_path, capture, **references_of(capture, "npy"), wavelengths=str(tmp_path / "nm.csv"))
    np.testing.assert_array_equal(scene.wavelengths_nm, np.delete(WAVELENGTHS_NM, 3))
    assert scene.fwhm_nm == pytest.approx(np.delete(WAVELENGTHS_NM, 3) / 50)


def test_copies_of_a_view_are_named_with_whether_their_poses_differ(tmp_path: Path):
    capture = make_capture(tmp_path / "capture", views=6)
    for copy, source in (("view_01", "view_00"), ("view_04", "view_03")):
        shutil.copy(capture.root / f"{source}.raw", capture.root / f"{copy}.raw")
    path = capture.root / "transforms.json"
    listed = json.loads(path.read_text())
    listed["frames"][4]["transform_matrix"] = listed["frames"][3]["transform_matrix"]
    path.write_text(json.dumps(listed))
    _, findings = made(tmp_path, capture, mask="none")
    [apart] = [line for line in findings if line.startswith("the very same values under different poses")]
    assert "poses: view_00 = view_01. " in apart
    [together] = [line for line in findings if line.startswith("the very same values under one pose")]
    assert "pose: view_03 = view_04. " in together


NAMES = ["view_00", "view_01", "view_02", "view_03"]
ORIENTATION = 0x0112


def write_views(root: Path, alpha: tuple[str, ...] = (), turned: tuple[str, ...] = ()) -> None:
    """Pictures of a textured square on a noisy grey ground."""
    generator = np.random.default_rng(0)
    (root / "images").mkdir(parents=True)
    for name in NAMES:
        pixels = generator.integers(81, 91, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        pixels[8:16, 8:20] = generator.integers(40, 120, (8, 12, 3))
        if name in alpha:
            pixels = np.dstack([pixels, np.full((HEIGHT, WIDTH), 255, np.uint8)])
        exif = Image.Exif()
        exif[ORIENTATION] = 6 if name in turned else 1
        Image.fromarray(pixels).save(root / "images" / f"{name}.png", exif=exif)
    write_poses(root / "transforms.json", NAMES)


def notes_of(root: Path, output: Path, wavelengths: str = "610,550,465", **options) -> str:
    """All that is said while the pictures become a scene."""
    told: list[str] = []
    process(root, output, "nerfstudio", told.append, wavelengths=wavelengths, **options)
    return "\n".join(told)


def test_alpha_that_some_views_lack_is_not_dropped_in_silence(tmp_path: Path):
    write_views(tmp_path / "capture", alpha=("view_00", "view_01", "view_03"))
    said = "1 of 4 views has no alpha channel (view_02), so that of the others is not used"
    assert said in notes_of(tmp_path / "capture", tmp_path / "scene")
    assert "alpha channel" not in notes_of(tmp_path / "capture", tmp_path / "asked", mask="none")


def test_wavelengths_from_short_to_long_are_questioned_and_turned_pictures_read_as_stored(tmp_path: Path):
    """With a note, and their poses name the orientation."""
    write_views(tmp_path / "capture", turned=("view_01", "view_02"))
    told = notes_of(tmp_path / "capture", tmp_path / "scene", "465,550,610")
    assert "465 nm is taken for red, 550 nm for green, 610 nm for blue" in told
    assert "give --wavelengths 610,550,465" in told
    told = notes_of(tmp_path / "capture", tmp_path / "usual")
    assert "taken for red" not in told
    assert "EXIF's orientation of 2 of 4 pictures is ignored" in told
    write_poses(tmp_path / "capture" / "transforms.json", NAMES[1:3], width=HEIGHT, height=WIDTH)
    with pytest.raises(CaptureError, match="or store them turned as EXIF's orientation says"):
        notes_of(tmp_path / "capture", tmp_path / "other")


@pytest.mark.parametrize("mask", ["black", "auto"])
def test_a_backdrop_is_cut_out_also_where_nobody_named_it(tmp_path: Path, mask):
    capture = make_capture(tmp_path / "capture", noise=4.0)
    scene, _ = made(tmp_path, capture, mask=mask, **references_of(capture))
    for index, frame in enumerate(scene.frames):
        np.testing.assert_array_equal(present(scene.alpha(index)) > 0.5, BRIGHT_SQUARE)
        assert scene.cube(index)[~BRIGHT_SQUARE].max() == 0.0
        expected = capture.reflectance[frame.name][BRIGHT_SQUARE]
        np.testing.assert_allclose(scene.cube(index)[BRIGHT_SQUARE], expected, atol=0.02)
    if mask == "auto":
        report = (tmp_path / "scene" / "report.txt").read_text()
        assert "backdrop black (0.020)" in report
        assert "- 25% of the pixels are foreground, the rest is cut out" in report
        plan = record_of(tmp_path / "scene")["plan"]
        assert plan["mask"] == "auto"
        assert plan["sensors"]["all views"]["background"]["kind"] == "found"


def test_without_a_backdrop_all_of_each_image_is_the_scene(tmp_path: Path, capture):
    generator = np.random.default_rng(0)
    for name in capture.reflectance:
        counts = generator.integers(200, 3000, (HEIGHT, WIDTH, 1)) * np.linspace(0.5, 1.0, 9)
        write_cube(capture.root, name, counts.astype(np.uint16))
    assert not made(tmp_path, capture, mask="auto")[0].has_alpha
    report = " ".join((tmp_path / "scene" / "report.txt").read_text().split())
    assert "none: all of each view is the scene" in report
