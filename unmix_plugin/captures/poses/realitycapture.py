"""Poses of RealityCapture and RealityScan: the table of Export > Registration, "Internal/External camera parameters".

Rotation of the camera (OpenGL axes) to the world: Rz(-heading) Rx(pitch) Ry(roll), degrees. f, px and py are in mm of a
picture whose longer side is 36 mm, px and py from its middle; k1 to k4, t1, t2 are Brown's, k by r^2, r^4, ...

Sources: RealityCapture help, Registration export; nerfstudio, process_data/realitycapture_utils.py.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from unmix_plugin.captures.names import path_text, size_of_view
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, make_pose_set, read_table
from unmix_plugin.engine.tables import Dialect, decode_text, named_rows
from unmix_plugin.errors import CaptureError, name_some

_POSE = ("x", "y", "alt", "heading", "pitch", "roll")
_DISTORTION = ("k1", "k2", "k3", "k4", "t1", "t2")
_WIDE_MM = 36.0
"""Width of the film that focal lengths are given for."""
_LARGEST_DEGREES_SPREAD = 0.5
_STEEPEST = 50.0
"""Heights that spread over so many times what x and y do, these by less than half a unit: x and y are degrees."""


def is_realitycapture(start: bytes) -> bool:
    """Whether the first bytes of a file are those of a table with a camera's angles."""
    text = decode_text(start).lower()
    return "name" in text and all(word in text for word in ("heading", "pitch", "roll"))


def read_realitycapture(path: Path, sizes: Mapping[str, tuple[int, int]]) -> PoseSet:
    """Poses of a table, with lenses where the size of a picture is known.

    Args:
        sizes: Width and height of views by name, file name or stem.
    Raises:
        CaptureError: columns are missing, a cell is no number, or positions are degrees.
    """
    try:
        table = named_rows(decode_text(read_table(path)), ("name", *_POSE[3:]))
    except csv.Error as error:
        raise CaptureError(f"{path} is no table ({error})") from error
    dialect, rows = table if table is not None else (Dialect(",", "."), [])
    rows = [(line, {"alt": row["z"], **row} if "z" in row else row) for line, row in rows]
    lacking = [key for key in (*_POSE, "f") if rows and key not in rows[0][1]]
    if not rows or lacking:
        raise CaptureError(
            f"{path} is a table of RealityCapture without {', '.join(lacking) or 'cameras'}; export the registration "
            "as 'Internal/External camera parameters'"
        )
    cameras, positions, without = [], [], []
    for line, row in rows:
        where = f"{path}, line {line}"
        x, y, height, heading, pitch, roll = (_number(row, key, dialect, where) for key in _POSE)
        name = path_text(row["name"])
        size = size_of_view(name, sizes)
        without += [] if size else [name]
        lens = None if size is None else _lens(row, size, dialect, where)
        position = np.array([x, y, height])
        # Rz Rx Ry of angles in degrees.
        angles = np.radians([-heading, pitch, roll])
        (cz, cx, cy), (sz, sx, sy) = np.cos(angles), np.sin(angles)
        about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
        about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
        positions.append(position)
        rotation = about_z @ about_x @ about_y
        cameras.append((name, PosedCamera(np.column_stack([rotation, position]), lens)))
    # Longitudes and latitudes would squeeze the scene flat.
    places = np.array(positions)
    across, up_and_down = np.ptp(places[:, :2], axis=0).max(), np.ptp(places[:, 2])
    is_on_earth = (np.abs(places[:, :2]) <= (180.0, 90.0)).all()
    if is_on_earth and 0 < across < _LARGEST_DEGREES_SPREAD and up_and_down > _STEEPEST * across:
        raise CaptureError(
            f"{path}: x and y spread over {across:.2g}, and heights over {up_and_down:.3g}: they look like degrees; "
            "export in a coordinate system in metres"
        )
    notes = [f"the size of {name_some(without)} is not known: without a lens"] if without else []
    up = np.array([0.0, 0.0, 1.0])
    return make_pose_set(cameras, f"RealityCapture's {path.name}", str(path), None, up, notes)


def _number(row: Mapping[str, str], key: str, dialect: Dialect, where: str) -> float:
    value = dialect.number(row.get(key, ""))
    if value is None or not np.isfinite(value):
        raise CaptureError(f"{where}: {key} is {row.get(key, '')!r}; expected a number")
    return value


def _lens(row: Mapping[str, str], size: tuple[int, int], dialect: Dialect, where: str) -> Lens:
    per_mm = max(size) / _WIDE_MM
    focal = _number(row, "f", dialect, where) * per_mm
    if not focal > 0:
        raise CaptureError(f"{where}: f is {row['f']}; expected mm above 0")
    width, height = size
    x, y, k1, k2, k3, k4, t1, t2 = (
        _number(row, key, dialect, where) if row.get(key) else 0.0 for key in ("px", "py", *_DISTORTION)
    )
    center = (width / 2 + x * per_mm, height / 2 + y * per_mm)
    return Lens(width, height, (focal, focal), center, (k1, k2, t1, t2), (k3, k4))
