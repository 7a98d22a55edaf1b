"""Scenes are the same up to rounding, and what differs is named."""

import json

import numpy as np
import pytest

from unmix_plugin.engine.runs.scene_record import differences, name_differences

SCENE = {
    "wavelengths_nm": [450.0, 550.0, 650.0],
    "frames": ["left", "right"],
    "cameras": {"width": 64, "pose": [[[1.0, 0.0, 0.25], [0.0, 1.0, 4.0]]]},
    "light": None,
    "has_alpha": True,
}


def test_a_scene_is_the_same_as_itself_read_back_from_json():
    assert differences(SCENE, json.loads(json.dumps(SCENE))) == []
    assert differences({"box": (1, 2)}, {"box": [1.0, 2.0]}) == []


def test_rounding_of_another_machine_is_no_difference():
    pose = np.nextafter(np.array(SCENE["cameras"]["pose"]), 9.0)
    assert differences(SCENE, {**SCENE, "cameras": {"width": 64, "pose": pose.tolist()}}) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"cameras": {"width": 65, "pose": SCENE["cameras"]["pose"]}}, "cameras.width"),
        ({"cameras": {"width": 64, "pose": [[[1.0, 0.0, 0.25], [0.0, 1.0, 4.01]]]}}, "cameras.pose"),
        ({"wavelengths_nm": [450.0, 550.0]}, "wavelengths_nm"),
        ({"wavelengths_nm": [[450.0], [550.0, 650.0]]}, "wavelengths_nm"),
        ({"frames": ["left", "middle"]}, "frames"),
        ({"light": [1.0, 0.5, 0.5]}, "light"),
        ({"has_alpha": 1}, "has_alpha"),
        ({"files": {}}, "files"),
    ],
)
def test_anything_else_is_a_difference_and_is_named(change, named):
    assert differences(SCENE, {**SCENE, **change}) == [named]
    assert differences({**SCENE, **change}, SCENE) == [named]


def test_long_lists_of_differences_are_cut_with_a_count():
    assert name_differences([f"file {i}" for i in range(9)]).endswith("file 4 and 4 more differ")
