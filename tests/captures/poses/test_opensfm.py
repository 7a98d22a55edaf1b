import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.captures.poses.pose_factory import (
    BROWN,
    PERSPECTIVE,
    as_json,
    assert_same_poses,
    reconstruction,
    ring,
    world_to_camera,
    write_json,
)
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError


def read(tmp_path, *contents):
    return read_poses(write_json(tmp_path / "reconstruction.json", list(contents)))


def lens_of(found):
    lens = next(iter(found.cameras.values())).lens
    assert lens is not None
    return lens


def test_the_reconstruction_with_the_most_shots_is_read(tmp_path):
    small = reconstruction()
    small["shots"].popitem()
    found = read(tmp_path, small, reconstruction())
    assert_same_poses(found, ring())
    assert any("2 reconstructions" in note for note in found.notes)
    assert found.points is not None
    assert found.colours is not None
    np.testing.assert_array_equal(found.points, [[1, 2, 3]])
    np.testing.assert_array_equal(found.colours, [[36, 25, 255]])


def test_lengths_are_in_parts_of_the_longer_side(tmp_path):
    lens = lens_of(read(tmp_path, reconstruction()))
    assert (lens.focal_px, lens.center_px, lens.distortion) == ((512, 512), (320, 240), (0.1, -0.05, 0, 0))
    lens = lens_of(read(tmp_path, reconstruction(BROWN)))
    assert lens.focal_px == pytest.approx((512, 480))
    assert lens.center_px == pytest.approx((240 + 6.4, 320 - 12.8))
    assert lens.distortion == (0.1, -0.05, 0.001, 0.002)


def test_poses_of_a_rig_are_composed(tmp_path):
    turn, shift = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), np.array([0.1, -0.2, 0.3])
    content = reconstruction()
    content["rig_cameras"] = {"left": as_json(turn, shift)}
    content["rig_instances"] = {}
    for name, shot in content["shots"].items():
        rotation, translation = world_to_camera(ring()[name])
        outer = as_json(turn.T @ rotation, turn.T @ (translation - shift))
        content["rig_instances"][name] = {**outer, "rig_camera_ids": {name: "left"}}
        del shot["rotation"], shot["translation"]
    assert_same_poses(read(tmp_path, content), ring())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": {}}, "names the camera"),
        ({"cameras": {"c": {**PERSPECTIVE, "projection_type": "spherical"}}}, "spherical.*expected one of"),
        ({"cameras": {"c": {**PERSPECTIVE, "focal": 0}}}, "not above 0"),
        ({"shots": {}}, "has no camera"),
        ({"shots": {"a": {"rotation": [1, 2], "translation": [0, 0, 0], "camera": "c"}}}, "3 finite numbers"),
        ({"points": {"1": {"coordinates": [1, None, 2]}}}, "a point has no 3 finite"),
    ],
)
def test_faults_are_told(tmp_path, change, message):
    with pytest.raises(CaptureError, match=message):
        read(tmp_path, reconstruction() | change)
