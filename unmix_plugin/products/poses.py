"""Cameras of all views with their poses as training corrected them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.products.product import Job, Product
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.trained_scene import TrainedScene

_LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")


@dataclass(frozen=True)
class Poses(Product):
    """Cameras of all views as transforms.json, in the world of the scene's poses; those of training views as training
    corrected them, where it did."""

    name = "poses"

    def write(self, job: Job) -> list[Path]:
        """Write transforms.json."""
        path = job.folder / "transforms.json"
        job.claim([path])
        make_folder(job.folder)
        scene = job.loaded.scene
        is_refined = isinstance(scene, TrainedScene) and "pose" in scene.fitted
        content = poses_json(scene.views, scene.frame, is_refined)
        write_file(path, (json.dumps(content, indent=1) + "\n").encode())
        return [path]


def poses_json(views: Sequence[RunView], frame: Normalisation, is_refined: bool) -> dict[str, Any]:
    """What the file says; `frame` leads from world to model space."""
    return {
        "camera_model": "OPENCV",
        "poses_refined": is_refined,
        "frames": [_entry(view, frame) for view in views],
    }


def _entry(view: RunView, frame: Normalisation) -> dict[str, Any]:
    camera = view.camera
    lens = torch.cat([camera.focal_px, camera.center_px, camera.distortion], dim=1)[0].tolist()
    width, height = camera.size(0)
    entry = {"name": view.name, "split": view.split, "w": width, "h": height}
    entry |= dict(zip(_LENS_KEYS, lens, strict=False))
    if camera.key_poses is None:
        return entry | {"transform_matrix": _matrix(camera.camera_to_world[0].double().numpy(), frame)}
    keys = zip(camera.key_poses.heights.tolist(), camera.key_poses.poses.double().numpy(), strict=True)
    return entry | {
        "key_poses": [{"row": y - 0.5, "transform_matrix": _matrix(pose, frame)} for y, pose in keys]
    }


def _matrix(pose: np.ndarray, frame: Normalisation) -> list[list[float]]:
    """Camera to world, 4 x 4."""
    rotation, position = frame.rotation.T @ pose[:, :3], frame.to_world(pose[:, 3])
    return [*np.column_stack([rotation, position]).tolist(), [0.0, 0.0, 0.0, 1.0]]
