"""Poses of LLFF: poses_bounds.npy, (N, 17): a 3 x 5 matrix [R | t | h, w, f] (axes down, right, back), near, far."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unmix_plugin.captures.poses.matching import BY_ORDER
from unmix_plugin.captures.poses.pose_set import Lens, PoseSet
from unmix_plugin.captures.poses.raw_poses import RawCamera, make_pose_set
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array, read_array_header

FILE_NAME = "poses_bounds.npy"
PICTURE_FOLDERS = ("images", "exr")
"""Where the pictures are, in the order of whose names the poses come."""


def read_llff(path: Path) -> PoseSet:
    """Poses in the order of the file, with the names of the pictures beside it where there are as many.

    Raises:
        CaptureError: it is not an array of the right shape, or a size or focal length makes no sense.
    """
    try:
        shape = read_array_header(path).shape
        is_table = len(shape) == 2 and shape[0] > 0 and shape[1] in (15, 17)
        table = np.array(map_array(path), dtype=np.float64) if is_table else None
    except UnreadableArrayError as error:
        raise CaptureError(f"{path} {error}") from error
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
    if table is None:
        raise CaptureError(f"{path} has the shape {shape}; expected (views, 17) numbers, as LLFF writes them")
    names, note = _names(path.parent, len(table))
    cameras = []
    for name, row in zip(names, table[:, :15].reshape(-1, 3, 5), strict=True):
        down, right, back, position, (height, width, focal) = row.T
        if not (1 <= width <= 1e6 and 1 <= height <= 1e6 and 0 < focal < 1e9):
            raise CaptureError(
                f"{path}: the camera of {name} has height, width, focal length {height:g}, {width:g}, {focal:g}; "
                "expected pixels above 0"
            )
        lens = Lens(
            round(width), round(height), (float(focal), float(focal)), (float(width) / 2, float(height) / 2)
        )
        cameras.append(RawCamera(name, np.column_stack([right, -down, back, position]), lens))
    return make_pose_set(cameras, f"LLFF's {path.name}", str(path), notes=[note])


def _names(folder: Path, count: int) -> tuple[list[str], str]:
    for place in PICTURE_FOLDERS:
        if (folder / place).is_dir():
            found = sorted(
                entry.name for entry in (folder / place).iterdir() if not entry.name.startswith(".")
            )
            if len(found) == count:
                return [
                    f"{place}/{name}" for name in found
                ], f"poses are those of {place}/ in the order of names"
    return [
        f"{BY_ORDER}{index:04d}" for index in range(count)
    ], "poses have no names: they go by the order of views"
