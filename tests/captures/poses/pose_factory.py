"""Cameras on a ring, for tests of readers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.scenes.scene_factory import ring_poses
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet

LENS = Lens(640, 480, (500.0, 510.0), (321.0, 239.0), (0.01, -0.02, 0.001, -0.002))
FLIP = np.diag([1.0, -1.0, -1.0])


def ring(count: int = 6) -> dict[str, np.ndarray]:
    """OpenGL camera to world (3, 4) by the name of the picture."""
    return {f"images/view_{index}.png": pose[:3] for index, pose in enumerate(ring_poses(count))}


def ring_set(count: int = 6, **changes: Any) -> PoseSet:
    """The ring as a `PoseSet`."""
    cameras = {name: PosedCamera(pose, LENS) for name, pose in ring(count).items()}
    return PoseSet(**{"cameras": cameras, "source": "a ring", **changes})


def transforms(poses: dict[str, np.ndarray], **top: Any) -> dict[str, Any]:
    """Content of a transforms.json."""
    (fl_x, fl_y), (cx, cy), (k1, k2, p1, p2) = LENS.focal_px, LENS.center_px, LENS.distortion
    lens = {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy, "k1": k1, "k2": k2, "p1": p1, "p2": p2}
    frames = [
        {"file_path": name, "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]}
        for name, pose in poses.items()
    ]
    return {"w": LENS.width, "h": LENS.height, **lens, **top, "frames": frames}


def write_json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def assert_same_poses(found: PoseSet, expected: dict[str, np.ndarray], atol: float = 1e-9) -> None:
    assert list(found.cameras) == list(expected)
    for name, pose in expected.items():
        camera_to_world = found.cameras[name].camera_to_world.copy()
        camera_to_world[:, 3] += found.offset
        np.testing.assert_allclose(camera_to_world, pose, atol=atol, err_msg=name)
