"""The file of refined cameras: in world space, of frame cameras readable as a camera file, of line cameras by row."""

import json
from dataclasses import replace

import numpy as np
import torch
from torch.testing import assert_close

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.products.poses import _poses_json
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.camera_files import read_camera_file
from unmix_plugin.trained.run_views import RunView

FRAME = Normalisation(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.3, 0.2, -1.0]), 0.5)
POSE = torch.tensor([[[0.0, 0, 1, 2.0], [1, 0, 0, 0.5], [0, 1, 0, 0.1]]])
LENS = (torch.tensor([[20.0, 21.0]]), torch.tensor([[6.0, 5.0]]), torch.tensor([[0.1, 0.0, 0.0, 0.0]]))
CAMERA = Cameras(POSE, *LENS, 12, 10)


def test_a_frame_camera_comes_back_as_it_was(tmp_path):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(_poses_json([RunView("a", CAMERA, "train")], FRAME, True)))
    found = read_camera_file(path, FRAME).views[0]
    assert found.name == "a"
    assert_close(found.camera.camera_to_world, CAMERA.camera_to_world, atol=1e-6, rtol=0)
    assert_close(found.camera.focal_px, CAMERA.focal_px)
    assert_close(found.camera.distortion, CAMERA.distortion)
    assert json.loads(path.read_text())["poses_refined"] is True


def test_a_line_camera_has_its_key_poses_at_rows():
    keys = KeyPoses(POSE.repeat(2, 1, 1), torch.tensor([0.5, 9.5]), (2,))
    lines = replace(CAMERA, key_poses=keys)
    entry = _poses_json([RunView("a", lines)], FRAME, False)["frames"][0]
    assert "transform_matrix" not in entry
    assert [key["row"] for key in entry["key_poses"]] == [0.0, 9.0]
    matrix = np.array(entry["key_poses"][1]["transform_matrix"])
    np.testing.assert_allclose(FRAME.to_model(matrix[:3, 3]), POSE[0, :, 3], atol=1e-6)
    np.testing.assert_allclose(FRAME.rotation @ matrix[:3, :3], POSE[0, :, :3], atol=1e-6)
