"""The lens in the tags against OpenCV's and Pix4D's formulas, written out point by point."""

import json
import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from tests.factories.captures import process
from tests.factories.data_sets import PLAIN
from tests.factories.files import file_of, present, write_band_file
from tests.factories.poses import by_hand
from tests.factories.rig_flight import (
    HEIGHT,
    LENSES,
    PANEL_LIGHT,
    PX_A_MM,
    WIDTH,
    file_name,
    image,
    lens_pose,
    write_flight,
    write_panel,
    write_poses,
)
from tests.factories.rig_flight import tags as tags_of
from unmix_plugin.captures.cube import BandTable, CameraTags, Cube, ReadOptions
from unmix_plugin.captures.layouts.rig import find_rig, lens_of, split_shots
from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.loader import load_scene


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    root = tmp_path_factory.mktemp("flight")
    write_flight(root, shots=8)
    (root / "IMG_170101_101000_0000_RGB.JPG").write_bytes(b"a picture in colour")
    return root


def _frames(scene):
    content = json.loads((scene / "transforms.json").read_text())
    return content, {frame["hyperspectral_file_path"]: frame for frame in content["frames"]}


@pytest.fixture(scope="module")
def scene(flight, tmp_path_factory):
    """The scene that the command makes from the poses of the green lens alone."""
    folder = tmp_path_factory.mktemp("scenes")
    write_poses(folder / "poses.json", shots=8)
    _process(flight, folder)
    return folder / "scene"


def _process(root, folder, **given):
    return process(root, folder / "scene", "rig", poses=str(folder / "poses.json"), mask="none", **given)


def _value(folder, index, lens):
    """What the scene stores for a lens of a shot, in the unit of the camera."""
    one = json.loads((folder / "process.json").read_text())["stored"]["calibrated_value_of_1"]
    path = next((folder / "cubes").glob(f"*_{index:04d}_{lens.ending}.npy"))
    return np.load(path)[..., 0] / 65535 * one, one


def test_every_file_is_a_view_of_its_lens_and_shot(flight):
    capture = find_rig(flight, PLAIN)
    assert len(capture.views) == 32
    assert {view.sensor for view in capture.views} == {"green", "red", "rededge", "nir"}
    shots = {(view.shot, view.name.split("_")[-2]) for view in capture.views}
    assert len(shots) == len({shot for shot, _ in shots}) == 8
    assert any("1 colour picture left out" in note for note in capture.notes)


def test_frames_have_their_band_lens_and_shot_and_shots_stay_together_when_views_are_split(scene):
    content, frames = _frames(scene)
    assert content["wavelengths"] == [550.0, 660.0, 735.0, 790.0]
    assert content["fwhm"] == [40.0, 40.0, 10.0, 40.0]
    assert len(frames) == 32
    for band, lens in enumerate(LENSES):
        frame = next(frame for path, frame in frames.items() if path.endswith(f"_0004_{lens.ending}.npy"))
        assert (frame["bands"], frame["sensor"]) == ([band], lens.name.lower())
        assert frame["fl_x"] == pytest.approx(lens.focal_mm * 20.0, abs=0.01)
        assert frame["capture"].endswith("_0004")
    evaluation = content["test_filenames"]
    assert (len(evaluation), len(content["train_filenames"])) == (4, 28)
    assert {path.rpartition("_")[0].rpartition("_")[2] for path in evaluation} == {"0004"}
    said = [line for line in (scene / "report.txt").read_text().splitlines() if "EXIF's orientation" in line]
    assert ["EXIF's orientation of 32 of 32 pictures is ignored" in line for line in said] == [True]


def test_what_is_evaluated_lies_in_the_middle_of_a_flight():
    for count, evaluated in ((1, [0]), (2, [1]), (5, [2]), (8, [4]), (12, [4]), (20, [4, 12])):
        splits = split_shots([f"IMG_{number:04d}" for number in range(count)])
        assert [number for number, split in enumerate(splits.values()) if split == "eval"] == evaluated, count


def test_names_that_differ_in_zeros_or_case_alone_have_one_order():
    for names in (["shot_1", "shot_01", "Shot_1", "shot_001"], ["shot_001", "Shot_1", "shot_01", "shot_1"]):
        assert sorted(names, key=natural_order) == ["Shot_1", "shot_001", "shot_01", "shot_1"]


def test_all_lenses_are_posed_by_the_rig(scene):
    """From the first one, in metres."""
    content, frames = _frames(scene)
    by_name = {path.rpartition("/")[2][-12:-4]: frame["transform_matrix"] for path, frame in frames.items()}
    poses = np.array([by_name[f"0006_{lens.ending}"] for lens in LENSES])
    found = np.linalg.inv(poses[0]) @ poses
    found[:, :3, 3] /= content.get("applied_scale", 1.0)
    expected = [np.linalg.inv(lens_pose(6, LENSES[0])) @ lens_pose(6, x, at_its_place=False) for x in LENSES]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_scene_holds_the_radiance_of_the_ground(scene):
    for lens in LENSES:
        found, one = _value(scene, 5, lens)
        np.testing.assert_allclose(found, np.minimum(image(5, lens), one), rtol=0.01)


def test_a_panel_before_the_flight_makes_reflectances(tmp_path):
    write_flight(tmp_path / "flight", shots=3)
    panel = write_panel(tmp_path / "flight")
    write_poses(tmp_path / "poses.json", shots=3)
    options = {"white_rectangle": (panel, 10, 12, 20, 30), "white_reflectance": "0.5"}
    _process(tmp_path / "flight", tmp_path, **options)
    assert not list((tmp_path / "scene" / "cubes").glob("*_9999_*"))
    np.testing.assert_array_equal(load_scene(tmp_path / "scene").illuminant, np.ones(len(LENSES)))
    for lens in LENSES:
        found, one = _value(tmp_path / "scene", 1, lens)
        expected = np.minimum(0.5 * image(1, lens) / PANEL_LIGHT[lens.ending], one)
        np.testing.assert_allclose(found, expected, rtol=0.01)


@pytest.mark.parametrize("is_told", [True, False])
def test_lenses_without_a_calibration_of_their_own_are_brought_to_one_exposure(tmp_path, is_told):
    """Or it is said that they are not."""
    card = np.linspace(2000, 4000, WIDTH) + np.zeros((HEIGHT, 1))
    for index, (lens, f_number) in product(range(3), zip(LENSES, (2.2, 4.4, 2.2, 2.2), strict=True)):
        own = tags_of(index, lens)
        del own["Camera:SensorModel"]
        told = {"ExposureTime": lens.exposure_s, "FNumber": f_number}
        counts = card * (lens.exposure_s / 0.004) * (2.2 / f_number) ** 2
        exif = {"FocalPlaneXResolution": PX_A_MM} | (told if is_told or lens.ending != "RED" else {})
        write_band_file(tmp_path / "flight" / file_name(index, lens), counts, own, exif)
    write_poses(tmp_path / "poses.json", shots=3)
    wrong = _process(tmp_path / "flight", tmp_path)
    means = [_value(tmp_path / "scene", 1, lens)[0].mean() for lens in LENSES]
    assert any("exposures of red are not known or not compared" in text for text in wrong) != is_told
    compared = means if is_told else [means[0], *means[2:]]
    np.testing.assert_allclose(compared, means[0], rtol=0.01)


ID = "MicaSense:CaptureId"


def rig_of(folder, files, size=(4, 5)):
    """The capture of files by name, with a wavelength (nm) and further tags."""
    for name, (centre, tags) in files.items():
        write_band_file(folder / name, np.full(size, 9), {"Camera:CentralWavelength": str(centre)} | tags)
    return find_rig(folder, PLAIN)


@pytest.mark.parametrize(
    ("files", "shots"),
    [
        ({f"DJI_00{number}.TIF": {} for number in (11, 12, 21)}, ["DJI_001", "DJI_001", "DJI_002"]),
        ({"IMG_0001_1.tif": {}, "IMG_0001_10.tif": {}}, ["IMG_0001", "IMG_0001"]),
        ({f"DJI_2023_0001_MS_{band}.TIF": {} for band in ("G", "NIR")}, ["DJI_2023_0001", "DJI_2023_0001"]),
        ({"a/IMG_0000_1.tif": {}, "b/IMG_0000_1.tif": {}}, ["a_IMG_0000", "b_IMG_0000"]),
        (  # by name where files share no identifier
            {f"IMG_000{n // 2}_{n % 2}.tif": {ID: str(n)} for n in range(4)},
            ["IMG_0000", "IMG_0000", "IMG_0001", "IMG_0001"],
        ),
        (  # by identifier where one name has two
            {f"IMG_0000_{n}.tif": {ID: "AABB"[n]} for n in range(4)},
            ["IMG_0000_A", "IMG_0000_A", "IMG_0000_B", "IMG_0000_B"],
        ),
    ],
)
def test_names_and_identifiers_of_makers_tell_shots(tmp_path, files, shots):
    views = rig_of(tmp_path, {name: (500, tags) for name, tags in files.items()}).views
    assert [view.shot for view in views] == shots


def test_a_file_without_the_calibration_that_others_of_its_lens_have_is_refused(tmp_path):
    """Its stored numbers would be thousands of times the radiance of the others."""
    write_flight(tmp_path / "flight", shots=3)
    write_poses(tmp_path / "poses.json", shots=3)
    path = next((tmp_path / "flight").glob("*_0001_RED.TIF"))
    path.write_bytes(path.read_bytes().replace(b"Camera:SensorModel>", b"Camera:SensorModeX>"))
    with pytest.raises(CaptureError, match=r"_0001_RED\.TIF has no calibration of its maker .*Parrot"):
        _process(tmp_path / "flight", tmp_path)


def test_lenses_are_told_by_their_file_or_index(tmp_path):
    files = {f"IMG_{n // 2:04d}_{1 + n % 2}.tif": (500 + 100 * (n % 2), {}) for n in range(4)}
    views = rig_of(tmp_path / "number", files).views
    assert [(view.name, view.sensor) for view in views] == [(n[:-4], n[-5]) for n in files]
    tags = {"Camera:BandName": "Red", "Camera:CaptureUUID": "A"}
    files = {f"IMG_0000_{n}.tif": (650 + n, tags | {"Camera:RigCameraIndex": str(n)}) for n in (0, 5)}
    assert [view.sensor for view in rig_of(tmp_path / "index", files).views] == ["red-0", "red-5"]


def test_thermal_bands_and_missing_bands_are_said(tmp_path):
    named = (("0000", "1", "B1", 501), ("0000", "2", "B2", 502), ("0000", "6", "LWIR", 11000))
    files = {f"IMG_{shot}_{n}.tif": (nm, {"Camera:BandName": band}) for shot, n, band, nm in named}
    capture = rig_of(tmp_path, files | {"IMG_0001_1.tif": (501, {"Camera:BandName": "B1"})})
    assert [view.name for view in capture.views] == ["IMG_0000_1", "IMG_0000_2", "IMG_0001_1"]
    notes = " ".join(capture.notes)
    assert "1 thermal image left out" in notes
    assert "1 of 2 shots lack a band: IMG_0001" in notes


def test_given_wavelengths_are_one_a_lens(tmp_path):
    for band in (1, 2):
        write_band_file(tmp_path / f"IMG_0000_{band}.tif", np.full((4, 5), 9), {})
    given = BandTable(np.array([500.0, 600.0]), fwhm_nm=np.array([10.0, 20.0]))
    views = find_rig(tmp_path, ReadOptions(bands=given)).views
    assert [view.cube.bands.wavelengths_nm for view in views] == [500.0, 600.0]
    assert [view.cube.bands.fwhm_nm for view in views] == [10.0, 20.0]
    with pytest.raises(CaptureError, match=r"gives 3 numbers for 2 lenses \(1, 2\)"):
        find_rig(tmp_path, ReadOptions(bands=BandTable(np.array([500.0, 600.0, 700.0]))))


@pytest.mark.parametrize(
    ("name", "size", "centre", "message"),
    [
        ("copy/IMG_0000_1.tif", (4, 5), 500, "are both the lens blue"),
        ("IMG_0001_1.tif", (4, 6), 500, "pixels"),
        ("IMG_0001_1.tif", (4, 5), 510, "nm, .* of the same lens"),
    ],
)
def test_files_of_one_lens_that_differ_or_stand_twice_are_refused(tmp_path, name, size, centre, message):
    tags = {"Camera:BandName": "Blue", ID: "same" if name.startswith("copy") else ""}
    rig_of(tmp_path, {"IMG_0000_1.tif": (500, tags)})
    with pytest.raises(CaptureError, match=message):
        rig_of(tmp_path, {name: (centre, tags)}, size)


LENS_WIDTH, LENS_HEIGHT = 1280, 960
EXIF = {"FocalPlaneXResolution": 266.667, "FocalPlaneYResolution": 266.667, "FocalPlaneResolutionUnit": 4}
PERSPECTIVE = {
    "Camera:ModelType": "perspective",
    "Camera:PrincipalPoint": "2.35,1.8",
    "Camera:PerspectiveFocalLength": "1449.36",
    "Camera:PerspectiveDistortion": ["-0.097", "0.14", "-0.023", "0.0003", "0.0007"],
}
FISHEYE = {
    "Camera:ModelType": "fisheye",
    "Camera:PrincipalPoint": "2.42299,1.850154",
    "Camera:FisheyeAffineMatrix": "1640.0,1.5,-0.5,1638.0",
    "Camera:FisheyePolynomial": "0,1,-0.025,0.15",
}
DJI = {
    "drone-dji:CalibratedOpticalCenterX": "640.0",
    "drone-dji:CalibratedOpticalCenterY": "480.0",
    "drone-dji:DewarpData": "2022-06-08;2200.5,2199.5,-4.25,7.5,0.008,-0.042,-0.0004,0.0002,-0.06",
}


def file_with(xmp, exif=EXIF) -> Cube:
    nothing = np.broadcast_to(np.uint16(0), (LENS_HEIGHT, LENS_WIDTH, 1))
    return replace(file_of(nothing, camera=CameraTags(xmp, exif)), path=Path("a.tif"))


GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 161), np.linspace(-0.65, 0.65, 131)), -1).reshape(-1, 2)


def worst_px(lens: Lens, expected: np.ndarray) -> float:
    """Greatest distance over directions that fall on the image."""
    inside = ((expected >= 0) & (expected <= (LENS_WIDTH, LENS_HEIGHT))).all(axis=1)
    return float(np.linalg.norm(lens.pixels_of(GRID) - expected, axis=1)[inside].max())


def in_plane(unit, resolution):
    return {f"FocalPlane{axis}Resolution": resolution for axis in "XY"} | {"FocalPlaneResolutionUnit": unit}


NO_THIRD = {"Camera:PerspectiveDistortion": ["-0.097", "0.14", "0", "0.0003", "0.0007"]}
IN_MM = {"Camera:PerspectiveFocalLength": "5.435"}
BENT = {"radial": (-0.097, 0.14, -0.023), "tangential": (0.0003, 0.0007)}
BENT |= {"focal": (1449.36, 1449.36), "center": (2.35 * 266.667 + 0.5, 1.8 * 266.667 + 0.5)}
BENT_MM = BENT | {"focal": (5.435 * 266.667, 5.435 * 266.667)}
BENT_DJI = {"radial": (0.008, -0.042, -0.06), "tangential": (-0.0004, 0.0002)}
BENT_DJI |= {"focal": (2200.5, 2199.5), "center": (640.0 - 4.25 + 0.5, 480.0 + 7.5 + 0.5)}


@pytest.mark.parametrize(
    ("tags", "exif", "expected"),
    [
        (PERSPECTIVE, EXIF, BENT),
        (PERSPECTIVE | NO_THIRD, EXIF, BENT | {"radial": (-0.097, 0.14)}),
        (PERSPECTIVE | IN_MM, EXIF, BENT_MM),  # told by its size
        (PERSPECTIVE | IN_MM | {"Camera:PerspectiveFocalLengthUnits": "mm"}, EXIF, BENT_MM),
        (PERSPECTIVE, in_plane(2, 266.667 * 25.4), BENT),
        (PERSPECTIVE, in_plane(3, 2666.67), BENT),
        (PERSPECTIVE, in_plane(4, 266.667), BENT),
        (DJI, {}, BENT_DJI),
    ],
)
def test_a_lens_of_tags_sees_what_formulas_of_their_makers_say(tags, exif, expected):
    lens = present(lens_of(file_with(tags, exif))[0])
    assert worst_px(lens, by_hand(GRID, **expected)) < 0.1
    assert lens.note == ""


def test_a_picture_that_dji_has_dewarped_has_no_distortion():
    for flag, terms in (("0", (0.008, -0.042, -0.0004, 0.0002, -0.06)), ("1", (0.0,) * 5)):
        lens = present(lens_of(file_with(DJI | {"drone-dji:DewarpFlag": flag}, {}))[0])
        assert (*lens.distortion, lens.higher_radial[0]) == terms
        assert (lens.focal_px, lens.center_px) == ((2200.5, 2199.5), (636.25, 488.0))
        assert ("DewarpFlag 1" in lens.note) == (flag == "1")


def test_a_fisheye_becomes_the_nearest_lens_and_pixels_are_brought_into_it():
    lens = present(lens_of(file_with(FISHEYE))[0])
    radius = np.linalg.norm(GRID, axis=1)
    theta = 2 / np.pi * np.arctan(radius)
    bent = theta - 0.025 * theta**2 + 0.15 * theta**3
    directions = GRID / np.maximum(radius, 1e-12)[:, None]
    expected = (bent[:, None] * directions) @ np.array([[1640.0, -0.5], [1.5, 1638.0]])
    expected += np.array([2.42299, 1.850154]) * 266.667 + 0.5
    worst = worst_px(lens, expected)
    assert 0.3 < worst < 4.0
    assert lens.resampled_from is not None
    np.testing.assert_allclose(lens.resampled_from(GRID), expected, atol=0.01)
    said = float(lens.note.split("nearer than ")[1].split()[0])
    assert said == pytest.approx(worst, rel=0.3)


@pytest.mark.parametrize(
    ("tags", "exif"),
    [
        ({}, EXIF),
        (PERSPECTIVE, {}),
        (PERSPECTIVE | {"Camera:PerspectiveFocalLength": "0"}, EXIF),
        (FISHEYE | {"Camera:FisheyeAffineMatrix": "1640.0"}, EXIF),
        (DJI | {"drone-dji:DewarpData": "2022-06-08;1,2"}, EXIF),
        (PERSPECTIVE | {"Camera:PrincipalPoint": "1e999,1", "Camera:PerspectiveDistortion": ""}, EXIF),
        (PERSPECTIVE, {"FocalPlaneXResolution": "many"}),
    ],
)
def test_without_the_tags_there_is_no_lens(tags, exif):
    lens, why = lens_of(file_with(tags, exif))
    assert lens is None
    assert "no lens in the file's tags" in why
    folding = PERSPECTIVE | {"Camera:PerspectiveDistortion": ["-3", "0", "0.5", "0", "0"]}
    with pytest.raises(CaptureError, match=r"a.tif, lens in the XMP"):
        lens_of(file_with(folding))


def test_a_panchromatic_band_is_left_out_with_a_note(flight, tmp_path):
    shutil.copytree(flight, tmp_path / "flight")
    for path in (tmp_path / "flight").glob("*_NIR.TIF"):
        path.write_bytes(path.read_bytes().replace(b"WavelengthFWHM>40<", b"WavelengthFWHM>99<"))
    assert len(find_rig(tmp_path / "flight", PLAIN).views) == 32
    for path in (tmp_path / "flight").glob("*_NIR.TIF"):
        path.write_bytes(path.read_bytes().replace(b"CentralWavelength>790<", b"CentralWavelength>390<"))
    capture = find_rig(tmp_path / "flight", PLAIN)
    assert {view.sensor for view in capture.views} == {"green", "red", "rededge"}
    said = "8 images of bands too broad for one wavelength left out: NIR"
    assert any(said in note for note in capture.notes)
