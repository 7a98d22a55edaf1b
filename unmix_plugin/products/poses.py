"""Cameras of all views with their poses as training corrected them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unmix_plugin.formats.files import make_folder, write_file
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Poses
from unmix_plugin.scenes.folder import METRES_KEY, transforms_bytes
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.camera_files import camera_entry
from unmix_plugin.trained.run_views import RunView


def export(job: Job, _: Poses) -> list[Path]:
    """Write transforms.json."""
    path = job.folder / "transforms.json"
    job.claim([path])
    make_folder(job.folder)
    scene = job.loaded.scene
    is_refined = "pose" in scene.fitted
    content = _poses_json(scene.views, scene.frame, is_refined)
    if job.loaded.scale is not None:
        content[METRES_KEY] = job.loaded.scale.metres_per_unit
    return [write_file(path, transforms_bytes(content))]


def _poses_json(views: Sequence[RunView], frame: Normalisation, is_refined: bool) -> dict[str, Any]:
    """What the file says; `frame` leads from world to model space."""
    frames = []
    for view in views:
        width, height = view.camera.size(0)
        frames.append({**camera_entry(view, frame), "split": view.split, "w": width, "h": height})
    return {"camera_model": "OPENCV", "poses_refined": is_refined, "frames": frames}
