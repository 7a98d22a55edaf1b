import json
import math
from contextlib import suppress
from itertools import product

import numpy as np
import pytest

from tests.factories.files import present
from tests.factories.scenes import fault_of, make_scene
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.frame_cameras import read_lens
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.loader import load_scene


def test_what_is_no_scene_folder_is_named(folder, tmp_path):
    with pytest.raises(SceneError, match="nowhere: the scene folder is not there"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"transforms\.json: is a file, not a scene folder; give the folder"):
        load_scene(folder.root / "transforms.json")
    (folder.root / "transforms.json").unlink()
    assert "transforms.json: is not in the scene folder; unmix-process makes a scene" in fault_of(folder)


def test_null_in_a_frame_leaves_the_lens_that_the_file_has(tmp_path):
    params = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    content = {"fl_x": 500.0, "camera_model": "OPENCV_FISHEYE", "distortion_params": params, "w": 64}
    faults = Faults(tmp_path)
    expected = present(read_lens(content, {}, "frame 0", faults))
    assert expected.model == "OPENCV_FISHEYE"
    assert read_lens(content, dict.fromkeys(content), "frame 0", faults) == expected
    read_lens({**content, "k6": 0.1}, {"k6": None}, "frame 0", faults)
    with pytest.raises(SceneError, match="'k6' is set"):
        faults.raise_if_any()


@pytest.mark.parametrize(
    ("scene", "frame", "expected"),
    [
        ({"distortion_params": [0.1, 0.2, 0, 0, 0, 0]}, {"k1": -0.3}, {"distortion": (-0.3, 0.2, 0, 0)}),
        ({"k1": 0.1, "k2": 0.2}, {"distortion_params": [-0.3, *[0] * 5]}, {"distortion": (-0.3, 0, 0, 0)}),
        ({"k1": 0.1, "distortion_params": [-0.3, 0, 0, 0, 0, 0]}, {}, {"distortion": (-0.3, 0, 0, 0)}),
        ({"camera_angle_x": 1.0}, {"x_fov": 30}, {"angles": (math.radians(30), None)}),
        ({"x_fov": 30}, {"camera_angle_x": 1.0}, {"angles": (1.0, None)}),
        ({"camera_angle_y": 1.0, "y_fov": 30}, {}, {"angles": (None, math.radians(30))}),
        ({}, {"camera_angle_x": 1.0, "x_fov": 30}, {"angles": (math.radians(30), None)}),
        ({"fl_x": 500, "fl_y": 510}, {"fl_x": 900}, {"focal_px": (900, 510)}),
    ],
)
def test_a_lens_given_twice_is_that_of_the_frame_and_degrees_go_first(tmp_path, scene, frame, expected):
    lens = present(read_lens(scene, frame, "frame 0", Faults(tmp_path)))
    assert {name: getattr(lens, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b'{"frames": [{"file_path": ', "is not valid JSON"),
        (b"", "is empty; expected JSON"),
        (b"[" * 100000, "is not readable as JSON"),
        (b"\x80\x81\xff\x00", "is not readable as JSON"),
        (b"[1, 2]", "holds a list of 2; expected an object"),
        (b'{"wavelengths": [450]}', "'frames' is absent"),
        (b'{"wavelengths": [450], "frames": []}', "'frames' is empty"),
        (b'{"frames": {"0": {}}}', "'frames' is an object; expected a list"),
    ],
)
def test_a_transforms_json_that_is_no_scene_is_refused(folder, text, message):
    (folder.root / "transforms.json").write_bytes(text)
    assert message in fault_of(folder)


GONE = object()


def with_values(content, change):
    """Give keys of the file, and those of frames by number, other values, or take them away."""
    for key, value in change.items():
        if isinstance(key, int) and isinstance(value, dict):
            with_values(content["frames"][key], value)
        elif isinstance(key, int):
            content["frames"][key] = value
        elif value is GONE:
            del content[key]
        else:
            content[key] = value


CUBE = "hyperspectral_file_path"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"wavelengths": GONE}, "'wavelengths' is absent"),
        ({"wavelengths": "450-680"}, "'wavelengths' is \"450-680\"; expected a list"),
        ({"wavelengths": []}, "'wavelengths' is a list of 0"),
        ({"wavelengths": [450, "520", 600, 680]}, "'wavelengths' has \"520\" at band 1"),
        ({"wavelengths": [450, 520, float("nan"), 680]}, "'wavelengths' has NaN at band 2"),
        ({"wavelengths": [450, 520, 10**400, 680]}, "'wavelengths' has 1000"),
        ({"wavelengths": [-450, 520, 600, 680]}, "'wavelengths' has -450 at band 0"),
        ({"wavelengths": [450, 600, 520, 680]}, "must increase; got 600 nm then 520 nm at band 2"),
        ({"wavelengths": [450, 520, 600]}, "the cube has 4 bands; expected 3, as 'wavelengths' lists"),
        ({"wavelengths": [0.45, 0.52, 0.6, 0.68]}, "look like micrometres; expected nm: multiply them by"),
        ({"wavelengths": [1, 2, 3, 4]}, "wavelengths of 1 to 4 count the bands; expected those of the"),
        ({"wavelengths": [450, 520, 600, 1e300]}, "expected 20 to 1e+06 nm"),
        ({"materials": "wood"}, "'materials' is \"wood\"; expected a list of different names"),
        ({"materials": ["wood", "wood"]}, "'materials' is a list of 2; expected a list of different"),
        ({"materials": ["wood", "iron"]}, "expected the 'materials' ['wood', 'iron']"),
        ({"illuminant_path": 7}, "'illuminant_path' is 7; expected a path"),
        ({"illuminant_path": "lamp.csv"}, "'illuminant_path': 'lamp.csv' is missing"),
        ({"illuminant_path": "../lamp.csv"}, "'illuminant_path': '../lamp.csv' leaves the scene folder"),
        ({"train_filenames": "all"}, "'train_filenames' is \"all\"; expected a list"),
        ({"test_filenames": ["images/x.png"]}, "lists 'images/x.png', which is the file_path of no"),
        ({"train_filenames": []}, "no frame is left to train on"),
        ({"train_filenames": ["images/view_0.png"]}, "frames[0]: is listed for training and for evaluation"),
        ({"fl_x": "wide"}, "'fl_x' is \"wide\"; expected a focal length above 0"),
        ({"fl_x": 0}, "'fl_x' is 0; expected a focal length above 0"),
        ({"fl_x": 1e-320}, "'fl_x' is 1e-320; expected a focal length above 0"),
        ({"cx": -1e300}, "'cx' is -1e+300; expected a finite number, at most 1e9"),
        ({"fl_x": GONE}, "'fl_x' is absent"),
        ({"fl_x": GONE, "camera_angle_x": 4}, "'camera_angle_x' is 4; expected radians"),
        ({"w": 20.5}, "'w' is 20.5; expected a whole number of pixels"),
        ({"w": 24}, "the cube has 20 x 16 pixels (width x height); expected 24 x 16, as 'w' and 'h'"),
        ({1: {"w": 24, "h": 16}}, "the cube has 20 x 16 pixels (width x height); expected 24 x 16, as 'w'"),
        ({"distortion_params": [0.1]}, "'distortion_params' is a list of 1; expected the numbers k1"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "camera_model PINHOLE comes with distortion"),
        ({"camera_model": "OPENCV_FISHEYE"}, "is not supported; expected one of PINHOLE, SIMPLE_PINHOLE"),
        ({"from_na": True}, "'from_na' is set, which stands for camera axes of OpenCV (NeuS2)"),
        ({"camera_model": ["OPENCV"]}, "camera_model a list of 1 is not supported"),
        ({2: "images/view_2.png"}, 'frames[2]: is "images/view_2.png"; expected an'),
        ({2: {CUBE: GONE}}, "frames[2]: has no 'hyperspectral_file_path'"),
        ({2: {CUBE: "\ud800.npy"}}, "is not readable as JSON (UnicodeEncodeError)"),
        ({2: {CUBE: 5}}, "frames[2]: 'hyperspectral_file_path' is 5; expected a path"),
        ({2: {CUBE: "a\0b"}}, "'hyperspectral_file_path' is \"a\\u0000b\"; expected a path"),
        ({2: {CUBE: "x" * 5000}}, "cannot be followed"),
        ({2: {CUBE: "cubes"}}, "frames[2]: 'cubes' is not a plain file"),
        ({2: {CUBE: "cubes/view_1.npy"}}, "is a duplicate: its cube 'cubes/view_1.npy'"),
        ({2: {CUBE: "cubes/none.npy"}}, "frames[2]: 'cubes/none.npy' is missing"),
        ({2: {"seg_file_path": "none.png"}}, "frames[2]: 'none.png' is missing"),
        *(
            ({"fwhm": widths}, "'fwhm' must have a width in nm above 0 for each")
            for widths in ([7.5, -1], [7.5] * 3, [-7.5] * 4, ["7.5"] * 4, 7.5)
        ),
    ],
)
def test_a_wrong_value_in_transforms_json_is_named_with_what_was_expected(folder, change, message):
    assert message in fault_of(folder.edit(lambda content: with_values(content, change)))


IDENTITY = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (GONE, "'transform_matrix' is absent"),
        ("identity", "'transform_matrix' is \"identity\"; expected 4 (or 3) rows"),
        ([*IDENTITY[:3], "0001"], 'is a list of 4 with "0001" in row 3; expected 4 (or 3) rows of 4'),
        ([IDENTITY[0], [float("nan"), 0, 0, 0], *IDENTITY[2:]], "is a list of 4 with NaN in row 1"),
        (np.diag([2.0, 2.0, 2.0, 1.0]).tolist(), "is not rigid: its axes have lengths (2, 2, 2)"),
        ([[1, 0.5, 0, 0], *IDENTITY[1:]], "is not rigid"),
        ([[1e200, 0, 0, 0], *IDENTITY[1:]], "is not rigid"),
        (np.zeros((4, 4)).tolist(), "is not rigid: its last row is (0, 0, 0, 0)"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]).tolist(), "is a reflection"),
        ([[1, 0, 0, 1e300], *IDENTITY[1:]], "expected less than 1e9 units away"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused_with_its_frame(folder, matrix, message):
    fault = fault_of(folder.edit(lambda content: with_values(content, {3: {"transform_matrix": matrix}})))
    assert "frames[3]" in fault
    assert message in fault


def test_garbage_in_place_of_any_value_is_a_fault_and_never_a_crash(tmp_path):
    folder = make_scene(tmp_path / "scene", frames=3)
    sound = folder.content
    garbage = ("x", -1, True, [], {}, [[]], float("nan"), 1e308, "..")
    accepted = []
    for key, value in product([*sound, *((1, key) for key in sound["frames"][1])], garbage):
        content = json.loads(json.dumps(sound))
        with_values(content, {key: value} if isinstance(key, str) else {1: {key[1]: value}})
        (folder.root / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
        with suppress(SceneError):
            load_scene(folder.root)  # a warning would be an error here, too
            accepted.append((key, value))
    # A principal point may lie outside the picture, and a scene may name no test views.
    assert accepted == [("cy", -1), ("test_filenames", [])]


@pytest.mark.parametrize(("last", "known"), [(7.5, True), (None, False), (0, False), (0.0, False)])
def test_widths_of_bands_are_unknown_where_one_is_null_or_0(folder, last, known):
    scene = load_scene(folder.edit(lambda c: c.update(fwhm=[7.5, 7.5, 7.5, last])).root)
    assert (scene.fwhm_nm is not None) == known
    if known:
        np.testing.assert_array_equal(scene.fwhm_nm, np.full(4, 7.5))
    assert ["'fwhm' has 0 or null for 1 of" in said for said in scene.warnings] == [True] * (not known)


def test_cameras_of_a_camera_file_in_model_space_are_named_where_a_world_is_expected(folder):
    for space, is_named in (("world", False), ("model", True)):
        warnings = load_scene(
            folder.edit(lambda content, space=space: content.update(space=space)).root
        ).warnings
        assert ["'space' is set and not followed" in warning for warning in warnings] == [True] * is_named
