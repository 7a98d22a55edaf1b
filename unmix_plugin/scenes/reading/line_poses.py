"""Poses of a line camera's frame: `row_poses`, one a row, or `key_poses`, between which poses are interpolated.

Row r of the image, counted from 0, is taken when the camera has the pose of row r; a key pose may be between rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.json_values import describe, read_number
from unmix_plugin.scenes.reading.poses import read_pose

ROW_POSES, KEY_POSES = "row_poses", "key_poses"
GREATEST_TURN_DEG = 90.0
"""Between neighbouring key poses: beyond, it is unclear which way the camera turned."""


@dataclass(frozen=True)
class LinePoses:
    """Checked poses of one line camera."""

    rows: Float64[np.ndarray, " n"]
    """Row of each pose, increasing."""
    poses: Float64[np.ndarray, "n 3 4"]
    """Camera to world, rotations orthonormal."""
    is_by_row: bool
    """Whether they were given row by row."""

    @property
    def middle(self) -> Float64[np.ndarray, "3 4"]:
        """The pose halfway through the image."""
        keys = KeyPoses(torch.from_numpy(self.poses), torch.from_numpy(self.rows), (len(self.rows),))
        y = torch.tensor([0.5 * (self.rows[0] + self.rows[-1])], dtype=torch.float64)
        return keys.at(torch.zeros(1, dtype=torch.int64), y)[0].numpy()

    def fault(self, num_rows: int) -> str | None:
        """Why the poses don't fit an image of so many rows; None if they do."""
        if self.is_by_row:
            if len(self.rows) == num_rows:
                return None
            found = f"'{ROW_POSES}' has {len(self.rows)} poses, but the cube has {num_rows} rows"
            return f"{found}; expected one pose a row"
        first, last = float(self.rows[0]), float(self.rows[-1])
        if first <= 0 and last >= num_rows - 1:
            return None
        return (
            f"'{KEY_POSES}' reach from row {first:g} to row {last:g}, but the cube has rows 0 to {num_rows - 1}; "
            "expected the first key pose at row 0 or before it, and the last at the last row or after it"
        )


def read_line_poses(frame: dict[str, Any], where: str, faults: Faults) -> LinePoses | None:
    """The poses of a line camera; None for a frame camera, and with a noted fault where they are wrong."""
    given = [key for key in (ROW_POSES, KEY_POSES) if frame.get(key) is not None]
    if not given:
        return None
    if len(given) == 2 or frame.get("transform_matrix") is not None:
        named = [*given, *(["transform_matrix"] if frame.get("transform_matrix") is not None else [])]
        faults.add(where, f"has {' and '.join(repr(key) for key in named)}; expected one of them")
        return None
    entries = frame[given[0]]
    if not isinstance(entries, list) or len(entries) < 2:
        faults.add(where, f"'{given[0]}' is {describe(entries)}; expected a list of at least two poses")
        return None
    is_by_row = given[0] == ROW_POSES
    found = _row_poses(entries, where, faults) if is_by_row else _key_poses(entries, where, faults)
    return None if found is None else _checked(*found, is_by_row, where, faults)


def _row_poses(entries: list[Any], where: str, faults: Faults) -> tuple[list[float], list[np.ndarray]] | None:
    poses = []
    for row, matrix in enumerate(entries):
        pose = read_pose(matrix, f"{where} '{ROW_POSES}'[{row}]", faults, "the pose")
        if pose is None:  # one is enough: a list of a thousand rows has them all wrong in one way
            return None
        poses.append(pose)
    return [float(row) for row in range(len(poses))], poses


def _key_poses(entries: list[Any], where: str, faults: Faults) -> tuple[list[float], list[np.ndarray]] | None:
    rows, poses = [], []
    for index, entry in enumerate(entries):
        here = f"{where} '{KEY_POSES}'[{index}]"
        row = read_number(entry.get("row")) if isinstance(entry, dict) else None
        if row is None:
            found = (
                f"has the row {describe(entry.get('row'))}"
                if isinstance(entry, dict)
                else f"is {describe(entry)}"
            )
            faults.add(here, f"{found}; expected an object with 'row' (a number) and 'transform_matrix'")
            return None
        pose = read_pose(entry.get("transform_matrix"), here, faults)
        if pose is None:
            return None
        rows.append(row)
        poses.append(pose)
    return rows, poses


def _checked(
    rows: list[float], poses: list[np.ndarray], is_by_row: bool, where: str, faults: Faults
) -> LinePoses | None:
    for before, after in pairwise(rows):
        if not after > before:
            faults.add(where, f"the rows of '{KEY_POSES}' must increase; got {before:g} then {after:g}")
            return None
    stacked = np.stack(poses)
    products = np.einsum("nab,nab->n", stacked[1:, :, :3], stacked[:-1, :, :3])
    turns = np.rad2deg(np.arccos(np.clip((products - 1) / 2, -1, 1)))
    largest = int(turns.argmax())
    if turns[largest] > GREATEST_TURN_DEG:
        faults.add(
            where,
            f"the camera turns by {turns[largest]:.0f} degrees from row {rows[largest]:g} to row "
            f"{rows[largest + 1]:g}; expected at most {GREATEST_TURN_DEG:g}, give more key poses",
        )
        return None
    return LinePoses(np.array(rows), stacked, is_by_row)
