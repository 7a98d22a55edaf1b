"""Lens and pose of a frame in transforms.json: of a frame camera one pose, of a line camera one per row or key poses.

Whatever is wrong is noted as a fault and gives None. Keys of a frame come before those of the whole scene. nerfstudio
reads a lens key of a frame only where the scene has none, so a warning says where both are given and differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.formats.json_values import describe, read_keys, read_number, read_numbers
from unmix_plugin.limits import GREATEST_PX
from unmix_plugin.scenes.folder import LensKeys, refused_keys
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.faults import Faults

_SUPPORTED_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")
_TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Of distortion, in the order of nerfstudio's `distortion_params`."""
_ANGLES = (("camera_angle_x", "x_fov"), ("camera_angle_y", "y_fov"))
"""Keys of the field of view along x and along y, in radians and in degrees."""
_RIGID_TOLERANCE = 5e-3
"""Largest element of R^T R - 1 that passes as rounding of printed digits; the rotation nearest to R is then taken."""
_MAX_DISTANCE = 1e9
"""Camera positions beyond this are damage; squares of larger ones would leave float32."""
_ROW_POSES, _KEY_POSES = "row_poses", "key_poses"
_GREATEST_TURN_DEG = 90.0
"""Between neighbouring key poses: beyond, it is unclear which way the camera turned."""


@dataclass(frozen=True)
class Intrinsics:
    """Lens of one frame. Sizes in pixels; None where the file says nothing."""

    model: Any
    """What `camera_model` or `is_fisheye` says; OPENCV where they are absent. Only `read_scene_lens` refuses models."""
    width: int | None
    height: int | None
    focal_px: tuple[float | None, float | None]
    """Along x and y."""
    angles: tuple[float | None, float | None] = (None, None)
    """Fields of view along x and y, radians."""
    center_px: tuple[float | None, float | None] = (None, None)
    """None is the middle of the image."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2."""
    higher_radial: tuple[float, float] = (0.0, 0.0)
    """k3, k4: radial terms of the sixth and eighth power."""

    def center_at(self, width: int, height: int) -> tuple[float, float]:
        """Principal point of an image of this size."""
        x, y = self.center_px
        return 0.5 * width if x is None else x, 0.5 * height if y is None else y

    def focal_at(self, width: int, height: int, is_line: bool = False) -> tuple[float, float] | None:
        """Focal lengths x, y in pixels of an image of this size; None if the file gives none.

        Each is the one given, or follows from the field of view, or is that of the other axis. A line camera
        (`is_line`) has that of x along both: where one pose stands for the view, its pixels are square.
        """
        x, y = (
            focal if focal is not None or angle is None else 0.5 * side / math.tan(0.5 * angle)
            for focal, angle, side in zip(self.focal_px, self.angles, (width, height), strict=True)
        )
        x, y = y if x is None else x, x if y is None else y
        return None if x is None or y is None else (x, x if is_line else y)


def read_lens(
    scene: Mapping[str, Any], frame: Mapping[str, Any], where: str, faults: Faults, is_scene: bool = False
) -> Intrinsics | None:
    """The lens of a frame of any transforms.json, whatever its model and whether or not it has a focal length.

    For every reader of such files: numbers are finite, sizes whole, focal lengths above 0, angles between 0 and pi.

    Args:
        scene: The whole file, whose keys hold for frames that lack them.
        frame: Keys of the frame.
        where: How messages call the frame.
        faults: Where faults are noted.
        is_scene: Whether rays are cast through the lens as it is.
    Returns:
        None, with noted faults, if a number is impossible.
    """
    noted_before = faults.noted
    own, common = (_in_our_keys(values, where, faults) for values in (frame, scene))
    for message in refused_keys(common, own, is_scene):
        faults.add(where, message)
    hidden = {key for names in _ANGLES if any(name in own for name in names) for key in names}
    if hidden and "fl_x" not in own and "fl_y" not in own:
        hidden |= {"fl_x", "fl_y"}  # a field of view of the frame goes before the scene's focal length
    common = {key: value for key, value in common.items() if key not in hidden and key not in own}
    lens, shared = (
        read_keys(values, LensKeys, partial(faults.note, place, Message.WRONG_VALUE))
        for values, place in ((own, where), (common, faults.file))
    )
    number: dict[str, float | None] = {}
    for key in LensKeys.__struct_fields__:
        value = getattr(lens, key)
        number[key] = getattr(shared, key) if value is None else value
    model = (
        number["camera_model"].upper() if isinstance(number["camera_model"], str) else number["camera_model"]
    )
    if number["is_fisheye"]:
        if model not in (None, "OPENCV_FISHEYE"):
            faults.note(where, Message.FISHEYE_CONTRADICTED, model=describe(model))
        model = "OPENCV_FISHEYE"
    if faults.noted > noted_before:
        return None
    x_fov, y_fov = (
        number[radians] if number[degrees] is None else math.radians(number[degrees] or 0.0)
        for radians, degrees in _ANGLES
    )
    k1, k2, k3, k4, p1, p2 = (number[key] or 0.0 for key in _TERMS)
    width, height = (None if side is None else int(side) for side in (number["w"], number["h"]))
    return Intrinsics(
        "OPENCV" if model is None else model,
        width,
        height,
        focal_px=(number["fl_x"], number["fl_y"]),
        angles=(x_fov, y_fov),
        center_px=(number["cx"], number["cy"]),
        distortion=(k1, k2, p1, p2),
        higher_radial=(k3, k4),
    )


def _in_our_keys(values: Mapping[str, Any], where: str, faults: Faults) -> dict[str, Any]:
    """Keys of a frame or of the scene that have a value, the lens by our own keys where it is given as NeuS2's matrix
    or as nerfstudio's list; of a field of view given twice, that in degrees, as in nerfstudio."""
    found: dict[str, Any] = {}
    matrix, listed = values.get("intrinsic_matrix"), values.get("distortion_params")
    if matrix is not None:
        rows = matrix[:3] if isinstance(matrix, list) else []
        numbers = read_numbers([row[:3] if isinstance(row, list) else row for row in rows], 3, 3)
        if numbers is None:
            faults.note(where, Message.NO_MATRIX, found=describe(matrix))
        else:
            (fx, skew, cx), (_, fy, cy), _ = numbers.tolist()
            found = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
            if min(fx, fy) <= 0 or abs(skew) > 1e-6 * fx:
                faults.note(where, Message.SKEWED_MATRIX, fx=fx, fy=fy, skew=skew)
                found = {}
    found |= {key: value for key, value in values.items() if value is not None}
    if listed is not None:
        terms = read_numbers(listed, len(_TERMS))
        if terms is None or np.abs(terms).max() > GREATEST_PX:
            faults.note(where, Message.NO_TERMS, found=describe(listed), terms=", ".join(_TERMS))
        else:
            found |= zip(_TERMS, terms.tolist(), strict=True)
    return {
        key: value
        for key, value in found.items()
        if not any(key == radians and degrees in found for radians, degrees in _ANGLES)
    }


def read_scene_lens(
    scene: Mapping[str, Any], frame: Mapping[str, Any], where: str, faults: Faults
) -> Intrinsics | None:
    """As `read_lens`, for lenses that rays are cast through; None and noted faults if it is not to be used."""
    noted_before = faults.noted
    lens = read_lens(scene, frame, where, faults, is_scene=True)
    model = "OPENCV" if lens is None else lens.model
    if model not in _SUPPORTED_MODELS:
        owner = where if frame.get("camera_model") is not None else faults.file
        faults.note(owner, Message.LENS_MODEL, model=describe(model), known=", ".join(_SUPPORTED_MODELS))
    focal_keys = ("fl_x", "camera_angle_x", "x_fov", "intrinsic_matrix")
    if all(values.get(key) is None for values in (frame, scene) for key in focal_keys):
        faults.note(where, Message.NO_FOCAL_LENGTH)
    if lens is not None and model in ("PINHOLE", "SIMPLE_PINHOLE"):
        (k1, k2, p1, p2), (k3, k4) = lens.distortion, lens.higher_radial
        terms = dict(zip(_TERMS, (k1, k2, k3, k4, p1, p2), strict=True))
        if any(terms.values()):
            faults.note(where, Message.PINHOLE_DISTORTED, model=model, terms=terms)
    return None if faults.noted > noted_before else lens


def read_pose(
    matrix: Any, where: str, faults: Faults, name: str = "'transform_matrix'"
) -> Float64[np.ndarray, "3 4"] | None:
    """Check a `transform_matrix` (4x4 or 3x4, OpenGL camera to world); None and a noted fault if it is not a pose.

    Args:
        name: What messages call it.
    """
    rows = read_numbers(matrix, 4, 4)
    rows = read_numbers(matrix, 3, 4) if rows is None else rows
    if rows is None:
        found = "is absent" if matrix is None else f"is {describe(matrix)}"
        for number, row in enumerate(matrix if isinstance(matrix, list) else []):
            is_row = isinstance(row, list) and len(row) == 4
            wrong = [value for value in row if read_number(value) is None] if is_row else [row]
            if wrong:
                found += f" with {describe(wrong[0])} in row {number}"
                break
        return faults.note(where, Message.NO_POSE, name=name, found=found)
    if len(rows) == 4 and np.abs(rows[3] - (0, 0, 0, 1)).max() > 1e-6:
        last = ", ".join(f"{value:g}" for value in rows[3])
        return faults.note(where, Message.LAST_ROW, name=name, row=last)
    rotation, position = rows[:3, :3], rows[:3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= _RIGID_TOLERANCE:
        lengths = ", ".join(f"{math.hypot(*axis):.4g}" for axis in rotation.T)  # hypot does not overflow
        return faults.note(where, Message.NOT_RIGID, name=name, lengths=lengths, deviation=deviation)
    if np.linalg.det(rotation) < 0.0:
        return faults.note(where, Message.REFLECTION, name=name)
    if np.abs(position).max() > _MAX_DISTANCE:
        return faults.note(where, Message.FAR_AWAY, name=name, position=position.tolist())
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, position[:, None]], axis=1)


@dataclass(frozen=True)
class LinePoses:
    """Checked poses of one line camera."""

    rows: Float64[np.ndarray, " n"]
    """Row of each pose, increasing."""
    poses: Float64[np.ndarray, "n 3 4"]
    """Camera to world, rotations orthonormal."""
    is_by_row: bool
    """Whether they were given row by row."""


def read_line_poses(frame: Mapping[str, Any], where: str, faults: Faults) -> LinePoses | None:
    """The poses of a line camera; None for a frame camera, and with a noted fault where they are wrong."""
    given = [key for key in (_ROW_POSES, _KEY_POSES, "transform_matrix") if frame.get(key) is not None]
    if given in ([], ["transform_matrix"]):
        return None
    if len(given) > 1:
        return faults.note(where, Message.SEVERAL_POSES, keys=" and ".join(map(repr, given)))
    [key] = given
    entries = frame[key]
    if not isinstance(entries, list) or len(entries) < 2:
        return faults.note(where, Message.NO_LINE_POSES, key=key, found=describe(entries))
    rows, poses = [], []
    for index, entry in enumerate(entries):
        place = f"{where} '{key}'[{index}]"
        # One fault is enough: a list of a thousand rows has them all wrong in one way.
        is_by_row, values = key == _ROW_POSES, entry if isinstance(entry, dict) else {}
        row = float(index) if is_by_row else read_number(values.get("row"))
        if row is None:
            code, found = (Message.NO_ROW, values.get("row")) if values else (Message.NO_KEY_POSE, entry)
            return faults.note(place, code, found=describe(found))
        matrix, name = (
            (entry, "the pose") if is_by_row else (values.get("transform_matrix"), "'transform_matrix'")
        )
        pose = read_pose(matrix, place, faults, name)
        if pose is None:
            return None
        if rows and row <= rows[-1]:
            return faults.note(where, Message.ROWS_FALL, key=key, before=rows[-1], after=row)
        rows.append(row)
        poses.append(pose)
    stacked = np.stack(poses)
    products = np.einsum("nab,nab->n", stacked[1:, :, :3], stacked[:-1, :, :3])
    turns = np.rad2deg(np.arccos(np.clip((products - 1) / 2, -1, 1)))
    largest = int(turns.argmax())
    if turns[largest] > _GREATEST_TURN_DEG:
        before, after = rows[largest : largest + 2]
        values = {"turn": turns[largest], "before": before, "after": after, "most": _GREATEST_TURN_DEG}
        return faults.note(where, Message.GREAT_TURN, **values)
    return LinePoses(np.array(rows), stacked, key == _ROW_POSES)


@dataclass(frozen=True)
class FrameCamera:
    """What took a frame, and from where; None where it is faulty."""

    lens: Intrinsics | None = None
    pose: Float64[np.ndarray, "3 4"] | None = None
    """Camera to world, rotation orthonormal; of a line camera halfway through its image, None before `at_size`."""
    lines: LinePoses | None = None
    """Of a line camera."""

    @staticmethod
    def read(scene: Mapping[str, Any], frame: Mapping[str, Any], where: str, faults: Faults) -> FrameCamera:
        """Lens and poses of a frame that rays are cast from."""
        noted_before = faults.noted
        lines = read_line_poses(frame, where, faults)
        pose = None
        if lines is None and faults.noted == noted_before:
            pose = read_pose(frame.get("transform_matrix"), where, faults)
        return FrameCamera(read_scene_lens(scene, frame, where, faults), pose, lines)

    def at_size(self, num_rows: int, where: str, faults: Faults) -> FrameCamera:
        """The camera with one pose for a line camera, too, that of the middle of its image; notes a fault where the
        poses of lines don't fit an image of so many rows."""
        if self.lines is None:
            return self
        first, last = float(self.lines.rows[0]), float(self.lines.rows[-1])
        if self.lines.is_by_row and len(self.lines.rows) != num_rows:
            faults.note(where, Message.ROW_POSES_MISFIT, poses=len(self.lines.rows), rows=num_rows)
        elif first > 0 or last < num_rows - 1:
            faults.note(where, Message.KEY_POSES_END, first=first, last=last, rows=num_rows - 1)
        count = len(self.lines.rows)
        keys = KeyPoses(torch.from_numpy(self.lines.poses), torch.from_numpy(self.lines.rows), (count,))
        middle = torch.tensor([0.5 * (num_rows - 1)], dtype=torch.float64)
        return replace(self, pose=keys.at(torch.zeros(1, dtype=torch.int64), middle)[0].numpy())


def make_cameras(
    cameras: Sequence[FrameCamera],
    sizes: Sequence[tuple[int, int]],
    to_model: Callable[[Float64[np.ndarray, "n 3 4"]], Float64[np.ndarray, "n 3 4"]],
) -> Cameras:
    """Cameras of all frames, in the space that their poses are brought to.

    Args:
        cameras: Without faults, at their sizes.
        sizes: Width and height of each frame's image.
        to_model: Moves poses from the space of transforms.json.
    """
    lenses = [camera.lens for camera in cameras if camera.lens is not None]
    poses = np.stack([camera.pose for camera in cameras if camera.pose is not None])
    assert len(lenses) == len(poses) == len(cameras)
    has_higher = any(any(lens.higher_radial) for lens in lenses)
    terms = [(*lens.distortion, *(lens.higher_radial if has_higher else ())) for lens in lenses]
    centers = [lens.center_at(*size) for lens, size in zip(lenses, sizes, strict=True)]
    focal_px = [
        lens.focal_at(*size, camera.lines is not None)
        for lens, size, camera in zip(lenses, sizes, cameras, strict=True)
    ]
    keys = []
    for camera, pose in zip(cameras, poses, strict=True):
        rows, own = (
            (np.zeros(1), pose[None]) if camera.lines is None else (camera.lines.rows, camera.lines.poses)
        )
        heights = torch.from_numpy(rows + 0.5).float()  # the pose of row r holds at its middle
        keys.append(KeyPoses(torch.from_numpy(to_model(own)).float(), heights, (len(rows),)))
    return Cameras.of_sizes(
        camera_to_world=torch.from_numpy(to_model(poses)).float(),
        focal_px=torch.tensor(focal_px, dtype=torch.float32),
        center_px=torch.tensor(centers, dtype=torch.float32),
        distortion=torch.tensor(terms, dtype=torch.float32),
        sizes=list(sizes),
        key_poses=KeyPoses.join(keys),
    )
