"""A tiny scene of line cameras: the ball of `scene_factory`, swept from a ring of directions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.scenes.scene_factory import FOCAL, HEIGHT, SPECTRUM, WIDTH, SceneFolder, make_scene, ring_poses

SWEEP = 1.0
"""How far each camera moves along its y axis from the first row to the last, to either side of the middle."""


def row_poses(pose: np.ndarray, num_rows: int = HEIGHT) -> list[np.ndarray]:
    """A camera that moves evenly down its own y axis while it takes the rows."""
    poses = []
    for row in range(num_rows):
        moved = pose.copy()
        moved[:3, 3] += (1.0 - 2.0 * row / (num_rows - 1)) * SWEEP * pose[:3, 1]
        poses.append(moved)
    return poses


def swept_alpha(pose: np.ndarray, radius: float) -> np.ndarray:
    """Which pixels (H, W) of the sweep have the ball at their middle."""
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    local = np.stack([x, np.zeros_like(x), -np.ones_like(x)], axis=-1)
    cover = np.zeros((HEIGHT, WIDTH))
    for row, own in enumerate(row_poses(pose)):
        directions = local @ own[:3, :3].T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        position = own[:3, 3]
        along = -(directions @ position)
        cover[row] = (position @ position - along**2 < radius**2) & (along > 0)
    return cover


def make_line_scene(root: Path, frames: int = 6, radius: float = 0.6) -> SceneFolder:
    """The scene of `make_scene` taken by line cameras; even frames say a pose a row, odd ones key poses."""
    scene, poses = make_scene(root, frames, radius=radius), ring_poses(frames)
    entries: list[dict[str, Any]] = scene.content["frames"]
    for index, (entry, pose) in enumerate(zip(entries, poses, strict=True)):
        cover = swept_alpha(pose, radius)
        np.save(root / entry["hyperspectral_file_path"], (cover[..., None] * SPECTRUM).astype(np.float16))
        grey, alpha = (200 * cover).astype(np.uint8), np.round(255 * cover).astype(np.uint8)
        Image.fromarray(np.stack([grey, grey, grey, alpha], axis=-1)).save(root / entry["file_path"])
        del entry["transform_matrix"], entry["seg_file_path"], entry["abundance_file_path"]
        matrices = [matrix.tolist() for matrix in row_poses(pose)]
        if index % 2:
            rows = (0, HEIGHT - 1)
            entry["key_poses"] = [{"row": row, "transform_matrix": matrices[row]} for row in rows]
        else:
            entry["row_poses"] = matrices
    return scene.edit(lambda content: content.update(frames=entries))
