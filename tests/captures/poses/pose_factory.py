"""Cameras on a ring, and files of other programs that tell of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

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
    whole = {name: [*pose.tolist(), [0, 0, 0, 1]] for name, pose in poses.items()}
    frames = [{"file_path": name, "transform_matrix": pose} for name, pose in whole.items()]
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


def lens_of(found: PoseSet) -> Any:
    """That of the first camera, which must be there."""
    lens = next(iter(found.cameras.values())).lens
    assert lens is not None
    return lens


def pixels_in_file(found: PoseSet, ideal: np.ndarray) -> np.ndarray:
    """Where the lens of the first camera's file shows ideal points, whether or not pixels are brought into another."""
    lens = lens_of(found)
    return lens.resampled_from(ideal) if lens.resampled_from else lens.pixels_of(ideal)


def by_hand(ideal, focal, center, radial=(), tangential=(0, 0), growth=(), skew=0.0, is_fisheye=False):
    """Where OpenCV's and Metashape's manuals say that ideal points are seen; p1, p2 in OpenCV's order."""
    x, y = ideal.T
    if is_fisheye:
        radius = np.hypot(x, y)
        x, y = (axis * np.arctan(radius) / np.maximum(radius, 1e-12) for axis in (x, y))
    squared, (p1, p2) = x**2 + y**2, tangential
    factor = 1 + sum(term * squared**power for power, term in enumerate(radial, 1))
    grown = 1 + sum(term * squared**power for power, term in enumerate(growth, 1))
    bent_x = x * factor + grown * (2 * p1 * x * y + p2 * (squared + 2 * x**2))
    bent_y = y * factor + grown * (2 * p2 * x * y + p1 * (squared + 2 * y**2))
    return np.column_stack([focal[0] * bent_x + skew * bent_y, focal[1] * bent_y]) + center


IDEAL = np.random.default_rng(0).uniform([-0.55, -0.4], [0.55, 0.4], (40, 2))
"""Ideal points that the lenses of these files see."""


def llff_table(poses, hwf=(480.0, 640.0, 500.0)):
    rows = []
    for pose in poses:
        right, up, back, position = pose.T
        rows.append([*np.column_stack([-up, right, back, position, hwf]).ravel(), 0.5, 9.0])
    return np.array(rows)


METASHAPE_SENSOR = """<sensor id="0" label="lens" type="{kind}"><resolution width="640" height="480"/>
<property name="pixel_width" value="0.004"/><property name="pixel_height" value="0.005"/>
<property name="focal_length" value="2"/>{calibration}</sensor>"""
METASHAPE_CALIBRATION = """<calibration type="{kind}" class="adjusted"><resolution width="640" height="480"/>
<f>500</f><cx>3</cx><cy>-4</cy>{terms}</calibration>"""


def text_of(matrix):
    return " ".join(repr(float(value)) for value in np.asarray(matrix).ravel())


def metashape_document(
    poses, component="", chunk="", terms="", kind="frame", calibration=METASHAPE_CALIBRATION, extra=""
):
    """What Metashape writes for cameras at these poses of the chunk, all in a group."""
    cameras = "".join(
        f'<camera id="{index}" sensor_id="0" component_id="0" label="{name}"><transform>'
        f"{text_of(np.vstack([np.column_stack([pose[:, :3] @ FLIP, pose[:, 3]]), [0, 0, 0, 1]]))}"
        "</transform></camera>"
        for index, (name, pose) in enumerate(poses.items())
    )
    sensor = METASHAPE_SENSOR.format(kind=kind, calibration=calibration.format(kind=kind, terms=terms))
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="c" enabled="true">{chunk}'
        f'<sensors>{sensor}</sensors><components><component id="0">{component}</component></components>'
        f'<cameras><group id="0">{cameras}</group>{extra}</cameras></chunk></document>'
    )


ORIENTATION = """<?xml version="1.0" ?><ExportAPERO><OrientationConique>
<FileInterne>Ori-All/AutoCal.xml</FileInterne><TypeProj>eProjStenope</TypeProj>
<Externe><Centre>{center}</Centre><ParamRotation><CodageMatr><L1>{l1}</L1><L2>{l2}</L2><L3>{l3}</L3>
</CodageMatr></ParamRotation></Externe><ConvOri><KnownConv>{convention}</KnownConv></ConvOri>
</OrientationConique></ExportAPERO>"""
CALIBRATION = """<?xml version="1.0" ?><ExportAPERO><CalibrationInternConique>
<KnownConv>eConvApero_DistM2C</KnownConv><PP>320.5 238.5</PP><F>500</F><SzIm>640 480</SzIm>
<CalibDistortion>{distortion}</CalibDistortion></CalibrationInternConique></ExportAPERO>"""
RADIAL = "<CDist>322 241</CDist><CoeffDist>{a}</CoeffDist><CoeffDist>-1e-14</CoeffDist>"


PERSPECTIVE = {
    "projection_type": "perspective", "width": 640, "height": 480, "focal": 0.8, "k1": 0.1, "k2": -0.05,
}  # fmt: skip
BROWN = {
    "projection_type": "brown", "width": 480, "height": 640, "focal_x": 0.8, "focal_y": 0.75, "c_x": 0.01, "c_y": -0.02,
    "k1": 0.1, "k2": -0.05, "k3": 0.0, "p1": 0.001, "p2": 0.002,
}  # fmt: skip


def world_to_camera(pose):
    rotation = (pose[:, :3] @ FLIP).T
    return rotation, -rotation @ pose[:, 3]


def as_json(rotation, translation):
    turn = Rotation.from_matrix(rotation).as_rotvec()
    return {"rotation": turn.tolist(), "translation": translation.tolist()}


def reconstruction(camera=PERSPECTIVE):
    shots = {name: {**as_json(*world_to_camera(pose)), "camera": "c"} for name, pose in ring().items()}
    points = {"7": {"coordinates": [1.0, 2.0, 3.0], "color": [36.0, 25.4, 300.0]}}
    return {"cameras": {"c": camera}, "shots": shots, "points": points}
