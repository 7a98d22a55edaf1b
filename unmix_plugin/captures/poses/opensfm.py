"""Poses of OpenSfM and OpenDroneMap: reconstruction.json.

Rotations are axis and angle from world to camera (OpenCV axes); lengths on the picture are in parts of its longer side.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses import lens
from unmix_plugin.captures.poses.pose_set import FLIP, PosedCamera, PoseSet, SparsePoints, make_pose_set
from unmix_plugin.errors import CaptureError, name_some
from unmix_plugin.formats.json_values import describe, read_number, read_numbers

_PLAIN = ("perspective", "simple_radial", "radial", "brown")
_SIX_TERMS = "k1 k2 k3 k4 k5 k6 p1 p2 s0 s1 s2 s3"
_DISTORTED: dict[str, tuple[lens.Distortion, str]] = {
    "fisheye": (lens.distort_fisheye, "k1 k2 k3 k4"),
    "fisheye_opencv": (lens.distort_fisheye, "k1 k2 k3 k4"),
    "fisheye62": (lens.distort_opensfm_624, _SIX_TERMS),
    "fisheye624": (lens.distort_opensfm_624, _SIX_TERMS),
    "dual": (lens.distort_dual, "transition k1 k2"),
    "spherical": (lens.distort_equirectangular, ""),
    "equirectangular": (lens.distort_equirectangular, ""),
}
"""Types of projection that are not ours: what distorts ideal points, and its numbers."""


def read_opensfm(path: Path, content: Any) -> PoseSet:
    """Poses, lenses and points of the reconstruction with the most shots, of a list of them or the only one. Raises
    CaptureError: there is none, a shot has no sound pose or camera, or a lens can't be represented."""
    listed = content if isinstance(content, list) else [content]
    parts = [part for part in listed if isinstance(part, dict) and isinstance(part.get("shots"), dict)]
    if not parts:
        raise CaptureError(
            f"{path} holds {describe(content)} without poses; expected 'frames' with 'transform_matrix' "
            "(transforms.json) or 'shots' (OpenSfM)"
        )
    best = max(parts, key=lambda part: len(part["shots"]))
    notes = [f"{len(parts)} reconstructions; the one with the most shots was read"] if len(parts) > 1 else []
    lenses: dict[str, lens.Lens] = {}
    raw, loose = [], []
    for name, shot in best["shots"].items():
        where = f"{path}: shot {name}"
        pose = _world_to_camera(best, name, shot, where)
        if pose is None:
            loose.append(name)
            continue
        camera = shot.get("camera")
        if not isinstance(camera, str) or camera not in _object(best, "cameras"):
            raise CaptureError(f"{where} names the camera {describe(camera)}; expected one of 'cameras'")
        if camera not in lenses:
            lenses[camera] = _lens_opensfm(_object(best["cameras"], camera), f"{path}: camera {camera}")
        rotation = pose[:, :3].T
        matrix = np.column_stack([rotation @ FLIP, -rotation @ pose[:, 3]])
        raw.append((name, PosedCamera(matrix, lenses[camera])))
    notes += [f"{len(loose)} shots have no pose: {name_some(loose)}"] if loose else []
    points = list(_object(best, "points").values())
    sparse: SparsePoints | None = None
    if points:
        found = [read_numbers(p.get("coordinates"), 3) if isinstance(p, dict) else None for p in points]
        if any(position is None for position in found):
            raise CaptureError(f"{path}: a point has no 3 finite 'coordinates'; the file is damaged")
        colours = [read_numbers(point.get("color"), 3) for point in points]
        known = [np.zeros(3) if colour is None else np.clip(colour, 0, 255) for colour in colours]
        sparse = np.array(found), np.array(known).round().astype(np.uint8)
    up = np.array([0.0, 0.0, 1.0])
    made = make_pose_set(raw, f"OpenSfM's {path.name}", str(path), sparse, up, notes)
    origin = _object(best, "reference_lla")  # of metres east, north and up; 0 where pictures had no place
    has_place = any(origin.get(key) for key in ("latitude", "longitude"))
    return replace(made, metres_per_unit=1.0 if has_place else None)


def _world_to_camera(
    content: dict[str, Any], name: str, shot: Any, where: str
) -> Float64[np.ndarray, "3 4"] | None:
    """The shot's own pose, otherwise that of its rig: first into the rig, then into its camera. None without either."""
    if not isinstance(shot, dict):
        raise CaptureError(f"{where} is {describe(shot)}; expected an object")
    if "rotation" in shot:
        return _pose(shot, where)
    rigs = _object(content, "rig_instances")
    for rig in rigs:
        lens_of = _object(_object(rigs, rig), "rig_camera_ids")
        if name in lens_of:
            in_rig = _object(_object(content, "rig_cameras"), lens_of[name])
            if not in_rig:
                raise CaptureError(f"{where} names {describe(lens_of[name])}, not in 'rig_cameras'")
            outer, inner = _pose(rigs[rig], where), _pose(in_rig, where)
            return np.column_stack([inner[:, :3] @ outer[:, :3], inner[:, :3] @ outer[:, 3] + inner[:, 3]])
    return None


def _pose(values: dict[str, Any], where: str) -> Float64[np.ndarray, "3 4"]:
    from scipy.spatial.transform import Rotation

    turn, shift = read_numbers(values.get("rotation"), 3), read_numbers(values.get("translation"), 3)
    if turn is None or shift is None:
        raise CaptureError(
            f"{where}: 'rotation' and 'translation', its own or its rig's, have to be 3 finite numbers each"
        )
    return np.column_stack([Rotation.from_rotvec(turn).as_matrix(), shift])


def _lens_opensfm(values: dict[str, Any], where: str) -> lens.Lens:
    def number(key: str, default: float = 0.0) -> float:
        value = read_number(values.get(key, default))
        if value is None:
            raise CaptureError(f"{where}: '{key}' is {describe(values[key])}; expected a finite number")
        return value

    width, height = int(number("width")), int(number("height"))
    kind = values.get("projection_type", "perspective")
    distort, keys = _DISTORTED.get(kind, (None, "")) if isinstance(kind, str) else (None, "")
    usual = 1 / (2 * np.pi) if distort is lens.distort_equirectangular else 0.0
    focal = number("focal_x", number("focal", usual))
    focal = focal, number("focal_y", focal)
    if not (0 < width < 1e6 and 0 < height < 1e6) or min(focal) <= 0:
        raise CaptureError(f"{where}: width, height or focal length is missing or not above 0")
    if distort is None and kind not in _PLAIN:
        raise CaptureError(
            f"{where} is {describe(kind)}; expected one of {', '.join((*_PLAIN, *_DISTORTED))}"
        )
    side = max(width, height)
    center = (width / 2 + side * number("c_x"), height / 2 + side * number("c_y"))
    start = lens.Lens(width, height, (side * focal[0], side * focal[1]), center)
    if distort is None:
        k1, k2, k3, p1, p2 = map(number, ("k1", "k2", "k3", "p1", "p2"))
        return replace(start, distortion=(k1, k2, p1, p2), higher_radial=(k3, 0.0))
    terms = [number(key, 1.0 if key == "transition" else 0.0) for key in keys.split()]
    return lens.distorted_lens(distort, terms, start, kind, where)


def _object(content: dict[str, Any], key: Any) -> dict[str, Any]:
    """The object below a key; an empty one without it."""
    value = content.get(key) if isinstance(key, str) else None
    return value if isinstance(value, dict) else {}
