"""The demo capture as scans of a line camera that moves: on a linear stage past the table, or on an arm around it.

Beside the raw counts of `demo` stand two tables of the same poses: `stages.csv` with a row a scan and what its stage
did, and `poses-true.csv` with the pose of each line.

Notation: `N` scans of `H` lines.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.captures.demo import PosesFile
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.tables import csv_bytes
from unmix_plugin.scenes.demo.scene import Place, demo_cameras
from unmix_plugin.scenes.demo.shading import speckled_things

STAGES, LINE_POSES = "stages.csv", "poses-true.csv"
LINE_SIZE, LINE_SCANS = 160, 24
"""Defaults: lines and columns of a scan, and scans."""
FIELD_OF_VIEW_DEG = 38.0
"""Of the line."""
_SWEEP = 2.4
"""How far the linear stage moves the camera, scene units, which pass for metres."""
_ARM_EVERY = 4
"""Which scan of so many is one from the arm, the last."""
_AXIS = (0.0, 0.0, 1.0)


def is_from_arm(index: int) -> bool:
    """Whether a scan goes all around the table, from above; others pass it."""
    return index % _ARM_EVERY == _ARM_EVERY - 1


def scanning_cameras(size: int, scans: int) -> Cameras:
    """Line cameras that begin on the dome of the demo's cameras: those of the linear stage go down their own y axis by
    2.4 units, those of the arm once around the z axis, counter clockwise seen from above."""
    still = demo_cameras(size, scans, FIELD_OF_VIEW_DEG)
    poses = still.camera_to_world.double().numpy()
    found = []
    for index, pose in enumerate(poses):
        if not is_from_arm(index):
            shares = 0.5 - (np.arange(size) + 0.5) / size
            lines = np.repeat(pose[None], size, axis=0)
            lines[:, :, 3] += _SWEEP * shares[:, None] * pose[:, 1]
        else:
            # The line stands upright: the camera, turned by a quarter, has its y axis against the way it goes.
            upright = np.column_stack([pose[:, 1], -pose[:, 0], pose[:, 2], pose[:, 3]])
            angles = 2 * np.pi * np.arange(size) / size
            cosine, sine, zero = np.cos(angles), np.sin(angles), np.zeros(size)
            turns = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1], axis=1)
            lines = turns.reshape(size, 3, 3) @ upright
        found.append(lines)
    stacked = torch.from_numpy(np.concatenate(found)).float()
    heights = (torch.arange(size) + 0.5).repeat(scans)
    return Cameras(
        still.camera_to_world,
        still.focal_px,
        still.center_px,
        still.distortion,
        size,
        size,
        key_poses=KeyPoses(stacked, heights, (size,) * scans),
    )


def _write_line_poses(folder: Path, cameras: Cameras) -> None:
    """Write both tables."""
    from scipy.spatial.transform import Rotation

    assert cameras.key_poses is not None
    axes = "xyz"
    of_lines = [["scan", "line", *(f"{axis} (m)" for axis in axes), "qw", "qx", "qy", "qz"]]
    heads = [f"{name}_{axis}" for name in ("look", "direction", "axis") for axis in axes]
    heads += [f"centre_{axis} (m)" for axis in axes]
    of_stages = [
        ["scan", "moves", *(f"{axis} (m)" for axis in axes), *heads, "step (m/line)", "turn (deg/line)"]
    ]
    for index in range(len(cameras)):
        lines = cameras.key_poses.of(index).poses.double().numpy()
        name = f"view_{index:03d}"
        quaternions = Rotation.from_matrix(lines[:, :, :3]).as_quat()[:, [3, 0, 1, 2]]
        for row, (pose, quaternion) in enumerate(zip(lines, quaternions, strict=True)):
            of_lines.append([name, str(row), *_texts(pose[:, 3]), *_texts(quaternion)])
        first, empty = lines[0], [""] * 3
        start = [name, "camera", *_texts(first[:, 3]), *_texts(-first[:, 2])]
        if is_from_arm(index):
            centre = _texts(np.zeros(3))
            of_stages.append(
                [*start, *empty, *_texts(np.array(_AXIS)), *centre, "", f"{360 / len(lines):.12g}"]
            )
        else:
            step = f"{_SWEEP / len(lines):.12g}"
            of_stages.append([*start, *_texts(-first[:, 1]), *empty, *empty, step, ""])
    write_file(folder / LINE_POSES, csv_bytes(of_lines))
    write_file(folder / STAGES, csv_bytes(of_stages))


def _texts(values: Float64[np.ndarray, " n"]) -> list[str]:
    return [f"{value:.9g}" for value in values]


SCANNED = Place(speckled_things(), scanning_cameras)
"""The table with speckles, and the cameras that scan it."""
STAGES_FILE = PosesFile(STAGES, _write_line_poses)
