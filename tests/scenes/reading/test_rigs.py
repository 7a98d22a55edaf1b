import json

import numpy as np
import pytest

from tests.factories.files import present
from tests.factories.scenes import RESPONSES, fault_of, halve, make_rig, set_frame
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import check_recorded_scene, scene_identity
from unmix_plugin.spectral.sensor import SceneSensor


def test_frames_have_the_size_and_bands_of_their_sensor(tmp_path):
    scene = load_scene(make_rig(tmp_path / "rig").root)
    assert scene.is_rig
    assert "colours.csv" in scene.input_hashes
    assert [frame.sensor for frame in scene.frames] == [0, 0, 0, 1, 1, 2]
    assert [sensor.name for sensor in scene.sensors] == ["4-bands-20x16", "small", "2-bands-20x16"]
    assert [sensor.bands for sensor in scene.sensors] == [(0, 1, 2, 3), (2, 0), None]
    for index, shape in ((0, (16, 20, 4)), (3, (8, 10, 2)), (5, (16, 20, 2))):
        assert scene.cube(index).shape == shape
        for read in (scene.alpha, scene.labels, scene.abundances, scene.valid_mask):
            assert present(read(index)).shape[:2] == shape[:2]
        assert scene.cameras.size(index) == shape[1::-1]


def test_channels_of_responses_are_weighted_means_in_the_order_of_the_columns(tmp_path):
    matrix = load_scene(make_rig(tmp_path / "rig").root).sensors[2].matrix
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0)
    red, blue = matrix  # of bands at 450, 520, 600 and 680 nm
    assert red.argmax() == 2
    assert blue.argmax() == 1
    assert red[3] == blue[3] == 0 < blue[0]


def test_frames_of_two_sizes_and_equal_bands_are_two_sensors_and_those_of_one_no_rig(folder):
    scene = load_scene(folder.root)
    assert not scene.is_rig
    assert not {"sensors", "frame_sensors"} & scene.summary().keys()
    halve(folder, 2)
    scene = load_scene(folder.root)
    assert [frame.sensor for frame in scene.frames] == [0, 0, 1, 0, 0, 0]
    assert all(sensor.sees_all_bands for sensor in scene.sensors)
    assert scene.is_rig


def test_a_record_of_a_rig_keeps_its_sensors_and_other_bands_are_another_scene(tmp_path):
    folder = make_rig(tmp_path / "rig")
    first = json.loads(json.dumps(load_scene(folder.root).summary()))
    check_recorded_scene(first)
    for damaged in ({}, {"bands": [7]}, {"responses": [[1.0, -1.0, 0, 0]]}):
        with pytest.raises((LookupError, ValueError)):
            check_recorded_scene({**first, "sensors": [{"name": "x", **damaged}]})
    again = [SceneSensor.from_json(values, 4) for values in first["sensors"]]
    for sensor, other in zip(load_scene(folder.root).sensors, again, strict=True):
        assert sensor.name == other.name
        np.testing.assert_array_equal(sensor.matrix, other.matrix)
    for index in (3, 4):
        folder.edit(set_frame(index, bands=[0, 2]))
    assert scene_identity(load_scene(folder.root).summary()) != scene_identity(first)


@pytest.mark.parametrize(
    ("frame", "values", "message"),
    [
        (3, {"bands": []}, "'bands' is a list of 0; expected indices into 'wavelengths'"),
        (3, {"bands": [0, True]}, "'bands' is a list of 2; expected indices into 'wavelengths'"),
        (3, {"bands": [1, 1]}, "'bands' repeats 1; expected each band once"),
        (3, {"bands": [1, 4]}, "'bands' has 4; expected 0 to 3, indices into 'wavelengths'"),
        (3, {"bands": [0, 1, 2]}, "the cube has 2 bands; expected 3, as its 'bands' list"),
        (3, {"responses_path": "colours.csv"}, "has 'bands' and 'responses_path'"),
        (5, {"responses_path": "none.csv"}, "'none.csv' is missing"),
        (3, {"sensor": 3}, "'sensor' is 3; expected a name"),
        (2, {"sensor": "small"}, "has 10 x 8 pixels, others of sensor 'small' 20 x 16; name it otherwise"),
        (4, {"bands": [2, 1]}, "has other bands than others of sensor 'small'; name it otherwise"),
    ],
)
def test_what_is_wrong_with_a_sensor_is_said(tmp_path, frame, values, message):
    assert message in fault_of(make_rig(tmp_path / "rig").edit(set_frame(frame, **values)))


def test_responses_beyond_the_bands_are_refused(tmp_path):
    folder = make_rig(tmp_path / "rig")
    (folder.root / "colours.csv").write_text(RESPONSES + "900,1,0\n", encoding="utf-8")
    fault = fault_of(folder)
    assert "left out red" in fault
    assert "'wavelengths' must cover all channels" in fault


def test_bands_that_no_training_frame_sees_are_refused(tmp_path):
    folder = make_rig(tmp_path / "rig")
    for index in (1, 2):
        folder.edit_cube(index, lambda cube: cube[..., :3]).edit(set_frame(index, bands=[0, 1, 2]))
    folder.edit(lambda content: content.update(train_filenames=["images/view_1.png", "images/view_2.png"]))
    assert "no training frame sees the bands at 680 nm" in fault_of(folder)
