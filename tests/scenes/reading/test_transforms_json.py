"""What can be wrong in transforms.json: each wrong value gets one clear message."""

import json

import numpy as np
import pytest

from tests.scenes.scene_factory import SceneFolder, fault_of, make_scene, set_frame
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.reading.transforms_json import read_lens


@pytest.fixture
def folder(tmp_path) -> SceneFolder:
    return make_scene(tmp_path / "scene")


def test_an_absent_folder_is_named(tmp_path):
    with pytest.raises(SceneError, match="nowhere: the scene folder is not there"):
        load_scene(tmp_path / "nowhere")


def test_a_file_in_place_of_the_folder_is_named(folder):
    with pytest.raises(SceneError, match=r"transforms\.json: is a file, not a scene folder; give the folder"):
        load_scene(folder.root / "transforms.json")


def test_an_absent_transforms_json_is_named(folder):
    (folder.root / "transforms.json").unlink()
    assert "transforms.json: is not in the scene folder" in fault_of(folder)


def test_null_in_a_frame_leaves_the_lens_that_the_file_has(tmp_path):
    params = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    content = {"fl_x": 500.0, "camera_model": "OPENCV_FISHEYE", "distortion_params": params, "w": 64}
    faults = Faults(tmp_path)
    expected = read_lens(content, {}, "frame 0", faults)
    assert expected is not None
    assert expected.model == "OPENCV_FISHEYE"
    assert read_lens(content, dict.fromkeys(content), "frame 0", faults) == expected
    read_lens({**content, "k6": 0.1}, {"k6": None}, "frame 0", faults)
    with pytest.raises(SceneError, match="'k6' is set"):
        faults.raise_if_any()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"frames": [{"file_path": ', "is not valid JSON"),
        ("", "is empty; expected JSON"),
        ("[" * 100000, "is not readable as JSON"),
        ("[1, 2]", "holds a list of 2; expected an object"),
        ("null", "holds null; expected an object"),
        ('{"wavelengths": [450]}', "'frames' is absent"),
        ('{"frames": {"0": {}}}', "'frames' is an object; expected a list"),
        ('{"frames": "all"}', "'frames' is \"all\"; expected a list"),
    ],
)
def test_a_transforms_json_that_is_no_scene_is_refused(folder, text, message):
    (folder.root / "transforms.json").write_text(text, encoding="utf-8")
    assert message in fault_of(folder)


def test_a_transforms_json_that_is_not_text_is_refused(folder):
    (folder.root / "transforms.json").write_bytes(b"\x80\x81\xff\x00")
    assert "is not readable as JSON" in fault_of(folder)


def test_a_scene_without_frames_is_refused(folder):
    folder.edit(lambda c: c.update(frames=[], train_filenames=[], test_filenames=[]))
    assert "'frames' is empty" in fault_of(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("wavelengths"), "'wavelengths' is absent"),
        (lambda c: c.update(wavelengths="450-680"), "'wavelengths' is \"450-680\"; expected a list"),
        (lambda c: c.update(wavelengths=[]), "'wavelengths' is a list of 0"),
        (lambda c: c.update(wavelengths=[450, "520", 600, 680]), "'wavelengths' has \"520\" at band 1"),
        (lambda c: c.update(wavelengths=[450, True, 600, 680]), "'wavelengths' has true at band 1"),
        (lambda c: c.update(wavelengths=[450, 520, float("nan"), 680]), "'wavelengths' has NaN at band 2"),
        (lambda c: c.update(wavelengths=[450, 520, 10**400, 680]), "'wavelengths' has 1000"),
        (lambda c: c.update(wavelengths=[-450, 520, 600, 680]), "'wavelengths' has -450 at band 0"),
        (
            lambda c: c.update(wavelengths=[450, 600, 520, 680]),
            "'wavelengths' must increase; got 600 nm then 520 nm at band 2",
        ),
        (
            lambda c: c.update(wavelengths=[450, 450, 520, 680]),
            "'wavelengths' must increase; got 450 nm then 450 nm",
        ),
        (
            lambda c: c.update(wavelengths=[450, 520, 600]),
            "the cube has 4 bands; expected 3, as 'wavelengths' lists",
        ),
        (
            lambda c: c.update(wavelengths=[0.45, 0.52, 0.6, 0.68]),
            "'wavelengths': wavelengths of 0.45 to 0.68 look like micrometres; expected nm: multiply them by 1000",
        ),
        (lambda c: c.update(wavelengths=[450, 520, 600, 1e300]), "expected 20 to 1e+06 nm"),
        (lambda c: c.update(materials="wood"), "'materials' is \"wood\"; expected a list of different names"),
        (
            lambda c: c.update(materials=["wood", "wood"]),
            "'materials' is a list of 2; expected a list of different",
        ),
        (lambda c: c.update(materials=["wood", "iron"]), "expected the 'materials' ['wood', 'iron']"),
        (lambda c: c.update(illuminant_path=7), "'illuminant_path' is 7; expected a path"),
        (lambda c: c.update(illuminant_path="lamp.csv"), "'illuminant_path': 'lamp.csv' is missing"),
        (lambda c: c.update(train_filenames="all"), "'train_filenames' is \"all\"; expected a list"),
        (
            lambda c: c.update(test_filenames=["images/x.png"]),
            "lists 'images/x.png', which is the file_path of no",
        ),
        (lambda c: c.update(fl_x="wide"), "'fl_x' is \"wide\"; expected a finite number"),
        (lambda c: c.update(fl_x=True), "'fl_x' is true; expected a finite number"),
        (lambda c: c.update(fl_x=0), "'fl_x' is 0; expected a focal length above 0"),
        (lambda c: c.update(fl_x=1e-320), "'fl_x' is 9.99989e-321; expected a focal length above 0"),
        (lambda c: c.update(cx=-1e300), "'cx' is -1e+300; expected a finite number, at most 1e9"),
        (lambda c: c.pop("fl_x"), "'fl_x' is absent"),
        (lambda c: (c.pop("fl_x"), c.update(camera_angle_x=4)), "'camera_angle_x' is 4; expected radians"),
        (lambda c: c.update(cx=float("inf")), "'cx' is Infinity; expected a finite number"),
        (lambda c: c.update(w=20.5), "'w' is 20.5; expected a whole number of pixels"),
        (lambda c: c.update(h=-16), "'h' is -16; expected a whole number of pixels"),
        (
            lambda c: c.update(w=24),
            "the cube has 20 x 16 pixels (width x height); expected 24 x 16, as 'w' and 'h'",
        ),
        (
            lambda c: c["frames"][1].update(w=24, h=16),
            "the cube has 20 x 16 pixels (width x height); expected 24 x 16, as 'w' and 'h' say",
        ),
        (
            lambda c: c.update(distortion_params=[0.1]),
            "'distortion_params' is a list of 1; expected the numbers k1",
        ),
        (lambda c: c.update(camera_model="PINHOLE", k1=0.1), "camera_model PINHOLE comes with distortion"),
        (
            lambda c: c.update(camera_model="OPENCV_FISHEYE"),
            'camera_model "OPENCV_FISHEYE" is not supported; expected one of PINHOLE, SIMPLE_PINHOLE, OPENCV',
        ),
        (lambda c: c.update(camera_model=["OPENCV"]), "camera_model a list of 1 is not supported"),
        (
            lambda c: c["frames"].__setitem__(2, "images/view_2.png"),
            'frames[2]: is "images/view_2.png"; expected an',
        ),
        (lambda c: c["frames"].__setitem__(2, None), "frames[2]: is null; expected an object"),
        (
            lambda c: c["frames"][2].pop("hyperspectral_file_path"),
            "frames[2]: has no 'hyperspectral_file_path'",
        ),
        (set_frame(2, hyperspectral_file_path=None), "frames[2]: has no 'hyperspectral_file_path'"),
        (set_frame(2, hyperspectral_file_path="\ud800.npy"), "is not readable as JSON (UnicodeEncodeError)"),
        (
            set_frame(2, hyperspectral_file_path=5),
            "frames[2]: 'hyperspectral_file_path' is 5; expected a path",
        ),
        (set_frame(2, hyperspectral_file_path=""), "'hyperspectral_file_path' is \"\"; expected a path"),
        (
            set_frame(2, hyperspectral_file_path="a\0b"),
            "'hyperspectral_file_path' is \"a\\u0000b\"; expected a path",
        ),
        (set_frame(2, hyperspectral_file_path="x" * 5000), "cannot be followed"),
        (set_frame(2, hyperspectral_file_path="cubes"), "frames[2]: 'cubes' is not a plain file"),
        (
            set_frame(2, hyperspectral_file_path="cubes/view_1.npy"),
            "is a duplicate: its cube 'cubes/view_1.npy'",
        ),
    ],
)
def test_a_wrong_value_in_transforms_json_is_named_with_what_was_expected(folder, change, message):
    assert message in fault_of(folder.edit(change))


IDENTITY = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (None, "'transform_matrix' is absent"),
        ("identity", "'transform_matrix' is \"identity\"; expected 4 (or 3) rows"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], "expected 4 (or 3) rows of 4 finite numbers"),
        ([*IDENTITY[:3], "0001"], 'is a list of 4 whose row 3 is "0001"; expected 4 (or 3) rows of 4'),
        ([["1", "0", "0", "0"], *IDENTITY[1:]], "expected 4 (or 3) rows of 4 finite numbers"),
        (
            [IDENTITY[0], [float("nan"), 0, 0, 0], *IDENTITY[2:]],
            "is a list of 4 rows with NaN in row 1; expected",
        ),
        ([[True, 0, 0, 0], *IDENTITY[1:]], "expected 4 (or 3) rows of 4 finite numbers"),
        (np.diag([2.0, 2.0, 2.0, 1.0]).tolist(), "is not rigid: its axes have lengths (2, 2, 2)"),
        ([[1, 0.5, 0, 0], *IDENTITY[1:]], "is not rigid"),
        ([[1e200, 0, 0, 0], *IDENTITY[1:]], "is not rigid"),
        (np.zeros((4, 4)).tolist(), "is not rigid: its last row is (0, 0, 0, 0)"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]).tolist(), "is a reflection"),
        ([[1, 0, 0, 1e300], *IDENTITY[1:]], "expected less than 1e9 units away"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused_with_its_frame(folder, matrix, message):
    def change(content):
        content["frames"][3].pop("transform_matrix")
        if matrix is not None:
            content["frames"][3]["transform_matrix"] = matrix

    fault = fault_of(folder.edit(change))
    assert "frames[3]" in fault
    assert message in fault


def test_garbage_in_place_of_any_value_is_a_fault_and_never_a_crash(tmp_path):
    folder = make_scene(tmp_path / "scene", frames=3)
    sound = folder.content
    garbage = ("x", -1, True, [], {}, [[]], float("nan"), 1e308, "..")
    places = [(sound_key,) for sound_key in sound] + [("frames", 1, key) for key in sound["frames"][1]]
    accepted, refused = [], []
    for place in places:
        for value in garbage:
            content = json.loads(json.dumps(sound))
            target = content
            for step in place[:-1]:
                target = target[step]
            target[place[-1]] = value
            (folder.root / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
            try:
                load_scene(folder.root)  # a warning would be an error here, too
            except SceneError as error:
                refused.append(str(error))
            else:
                accepted.append((place, value))
    assert all(str(folder.root) in message for message in refused)
    # A principal point may lie outside the picture, and a scene may name no test views.
    assert accepted == [(("cy",), -1), (("test_filenames",), [])]


def test_widths_of_bands_are_read_and_must_be_one_a_band(folder):
    count = len(load_scene(folder.root).wavelengths_nm)
    folder.edit(lambda c: c.update(fwhm=[7.5] * count))
    np.testing.assert_array_equal(load_scene(folder.root).fwhm_nm, np.full(count, 7.5))
    for faulty in ([7.5, -1], [7.5] * (count - 1), [-7.5] * count, ["7.5"] * count, 7.5):
        folder.edit(lambda c, faulty=faulty: c.update(fwhm=faulty))
        assert "'fwhm' must have a width in nm above 0 for each of the wavelengths" in fault_of(folder)


@pytest.mark.parametrize("unknown", [None, 0, 0.0])
def test_widths_are_unknown_where_one_is_null_or_0(folder, unknown):
    known = [7.5] * (len(load_scene(folder.root).wavelengths_nm) - 1)
    scene = load_scene(folder.edit(lambda c: c.update(fwhm=[*known, unknown])).root)
    assert scene.fwhm_nm is None
    assert [said for said in scene.warnings if "'fwhm' has 0 or null for 1 of" in said] == [
        scene.warnings[-1]
    ]
