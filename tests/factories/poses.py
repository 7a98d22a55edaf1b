"""Cameras on a ring, files of other programs that tell of them, and how near found poses are to true ones.

Notation: `N` cameras, `P` points.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.factories.scenes import ring_poses
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.engine.geometry.camera_paths import focus_point
from unmix_plugin.scenes.placement import Placement

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


Poses = Float64[np.ndarray, "N 3 4"]


@dataclass(frozen=True)
class Alignment:
    """How estimated poses differ from true ones."""

    similarity: Placement
    """From the estimated world to the true one."""
    names: tuple[str, ...]
    """Images that both have."""
    errors_px: Float64[np.ndarray, " N"]
    """Root mean square distance of projected points, for each of them."""
    rotation_errors_deg: Float64[np.ndarray, " N"]
    position_errors: Float64[np.ndarray, " N"]
    """In units of the true world."""

    @property
    def rms_px(self) -> float:
        """Root mean square over all cameras."""
        return float(np.sqrt(np.mean(self.errors_px**2)))


def align_poses(estimated: PoseSet, truth: PoseSet, names: dict[str, str] | None = None) -> Alignment:
    """Find the similarity after which the estimated cameras see points where the true ones do, and what is left.

    Points are the sparse ones of the true poses or of the estimated ones, or some around where the cameras look.

    Args:
        names: True name of each estimated one; None where both are the same.
    """
    pairs = names or {name: name for name in estimated.cameras}
    shared = {a: b for a, b in pairs.items() if a in estimated.cameras and b in truth.cameras}
    assert len(shared) >= 3
    mine, theirs = [estimated.cameras[a] for a in shared], [truth.cameras[b] for b in shared.values()]
    first, reach = _first_guess(_stacked(mine), _stacked(theirs))
    points = truth.points
    if points is None:
        around = _around(_stacked(theirs), reach)
        points = around if estimated.points is None else first.to_scene(estimated.points)
    points = points[:: max(1, len(points) // 400)]
    wanted = np.stack([camera.pixels_of(points) for camera in theirs])
    sizes = np.array([[c.lens.width, c.lens.height] for c in theirs if c.lens is not None])[:, None]
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((wanted >= 0) & (wanted <= sizes)).all(axis=-1))
    seen = np.isfinite(wanted).all(axis=-1) & (inside | (inside.sum(axis=1) == 0)[:, None])
    pivot = points.mean(axis=0)

    def changed(step: np.ndarray) -> Placement:
        """The first guess, then a turn, growth and shift about the middle of the points."""
        turn, growth = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[3]))
        shift = pivot + step[4:] - growth * turn @ pivot
        scale = first.scale * growth
        return Placement(turn @ first.rotation, turn @ first.translation + shift / scale, scale)

    def off(way: Placement) -> Float64[np.ndarray, "N P 2"]:
        return np.stack([camera.moved(way).pixels_of(points) for camera in mine]) - wanted

    def errors(step: np.ndarray) -> np.ndarray:
        return np.nan_to_num(off(changed(step))[seen].ravel(), nan=1e4)

    best = changed(least_squares(errors, np.zeros(7), x_scale=[1e-3] * 4 + [1e-3 * reach] * 3).x)
    squared = np.where(seen, (off(best) ** 2).sum(axis=-1), np.nan)
    found, true = _stacked([camera.moved(best) for camera in mine]), _stacked(theirs)
    turns = Rotation.from_matrix(found[:, :, :3].transpose(0, 2, 1) @ true[:, :, :3]).magnitude()
    places = np.linalg.norm(found[:, :, 3] - true[:, :, 3], axis=1)
    errors_px = np.sqrt(np.nanmean(squared, axis=1))
    return Alignment(best, tuple(shared.values()), errors_px, np.degrees(turns), places)


def _stacked(cameras: list[PosedCamera]) -> Poses:
    return np.stack([camera.camera_to_world for camera in cameras])


def _first_guess(mine: Poses, theirs: Poses) -> tuple[Placement, float]:
    """By the mean turn, middle and extent of the cameras; and the extent of the true ones."""
    middles = [poses[:, :, 3].mean(axis=0) for poses in (mine, theirs)]
    away = [poses[:, :, 3] - middle for poses, middle in zip((mine, theirs), middles, strict=True)]
    extents = [float(np.linalg.norm(steps, axis=1).mean()) or 1.0 for steps in away]
    scale = extents[1] / extents[0]
    turns = Rotation.from_matrix(theirs[:, :, :3] @ mine[:, :, :3].transpose(0, 2, 1))
    rotation = turns.mean().as_matrix()
    return Placement(rotation, middles[1] / scale - rotation @ middles[0], scale), extents[1]


def _around(poses: Poses, reach: float) -> Float64[np.ndarray, "P 3"]:
    """A cross around where the cameras look."""
    middle = focus_point(poses)
    if middle is None:
        middle = (poses[:, :, 3] - reach * poses[:, :, 2]).mean(axis=0)
    return middle + 0.1 * reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


TURN = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
SIMILARITY = Placement(TURN, np.array([1.0, 2.0, -3.0]), 2.5)


def elsewhere(poses: PoseSet) -> PoseSet:
    back = SIMILARITY.rotation.T
    way = Placement(back, -SIMILARITY.scale * back @ SIMILARITY.translation, 1 / SIMILARITY.scale)
    return replace(poses, cameras={name: camera.moved(way) for name, camera in poses.cameras.items()})


def in_a_row() -> PoseSet:
    poses = {str(x): np.column_stack([np.eye(3), [x, 0.0, 5.0 + 0.1 * x]]) for x in range(4)}
    return PoseSet({name: PosedCamera(pose, LENS) for name, pose in poses.items()}, "a row")
