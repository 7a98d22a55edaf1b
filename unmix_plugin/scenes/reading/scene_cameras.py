"""Cameras of the frames of transforms.json."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.scenes.reading.images import Size
from unmix_plugin.scenes.reading.transforms_json import Intrinsics, SceneEntry
from unmix_plugin.scenes.scene import Normalisation


def make_cameras(entry: SceneEntry, sizes: list[Size], normalisation: Normalisation) -> Cameras:
    """Cameras of all frames.

    Args:
        entry: Without faults.
        sizes: Height and width of each frame's image.
        normalisation: From the space of transforms.json to that of the cameras.
    """
    lenses = [frame.intrinsics for frame in entry.frames if frame.intrinsics is not None]
    assert len(lenses) == len(entry.frames)
    centers = [
        [
            0.5 * side if value is None else value
            for value, side in zip(lens.center_px, size[::-1], strict=True)
        ]
        for lens, size in zip(lenses, sizes, strict=True)
    ]
    focal_px = [lens.focal_at(width) for lens, (_, width) in zip(lenses, sizes, strict=True)]
    return Cameras.of_sizes(
        camera_to_world=_model_poses(world_poses(entry), normalisation),
        focal_px=torch.tensor(focal_px, dtype=torch.float32),
        center_px=torch.tensor(centers, dtype=torch.float32),
        distortion=_distortion(lenses),
        sizes=[(width, height) for height, width in sizes],
        key_poses=_key_poses(entry, normalisation),
    )


def world_poses(entry: SceneEntry) -> Float64[np.ndarray, "N 3 4"]:
    """One pose a frame, as transforms.json has it; of a line camera halfway through the image."""
    poses = [frame.pose for frame in entry.frames if frame.pose is not None]
    assert len(poses) == len(entry.frames)
    return np.stack(poses)


def _model_poses(
    poses: Float64[np.ndarray, "n 3 4"], normalisation: Normalisation
) -> Float[torch.Tensor, "n 3 4"]:
    rotations = normalisation.rotation @ poses[:, :, :3]
    positions = normalisation.to_model(poses[:, :, 3])
    return torch.from_numpy(np.concatenate([rotations, positions[:, :, None]], axis=-1)).float()


def _key_poses(entry: SceneEntry, normalisation: Normalisation) -> KeyPoses | None:
    """Poses by height in the image, where a frame is of a line camera; row r is taken at r + 0.5."""
    if all(frame.line_poses is None for frame in entry.frames):
        return None
    parts = []
    for frame, pose in zip(entry.frames, world_poses(entry), strict=True):
        lines = frame.line_poses
        rows, poses = (np.zeros(1), pose[None]) if lines is None else (lines.rows, lines.poses)
        heights = torch.from_numpy(rows + 0.5).float()
        parts.append(KeyPoses(_model_poses(poses, normalisation), heights, (len(rows),)))
    return KeyPoses.join(parts)


def _distortion(lenses: list[Intrinsics]) -> Float[torch.Tensor, "N D"]:
    """Coefficients of all lenses: six where any has higher radial terms, otherwise four."""
    count = max(len(lens.coefficients) for lens in lenses)
    rows = [(*lens.distortion, *lens.higher_radial)[:count] for lens in lenses]
    return torch.tensor(rows, dtype=torch.float32)
