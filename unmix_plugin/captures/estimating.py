"""Poses of written views, estimated from pictures of their cubes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.poses.contrast import contrast_picture, mean_weights
from unmix_plugin.captures.poses.estimation import estimate_poses
from unmix_plugin.captures.poses.pose_set import PoseSet
from unmix_plugin.captures.writing.view_files import FULL_SCALE, ViewRecord
from unmix_plugin.scenes.reading.cubes import map_array


def estimated_poses(plan: Plan, records: Mapping[str, ViewRecord], scene: Path, work: Path) -> PoseSet:
    """Structure from motion on all views.

    Args:
        plan: Of the scene.
        records: Of its views, which are all written.
        scene: Folder that they are in.
        work: Folder for files of the estimation.
    Returns:
        Poses by view, with lenses of the whole images as the capture has them.
    Raises:
        CaptureError: pycolmap is not installed, or too few views could be registered.
    """
    shown = {name: _shown(scene, record) for name, record in records.items()}
    pictures = {name: _picture(scene, records[name], shown[name]) for name in records}
    sensors = {view.name: view.sensor for view in plan.views}
    poses = estimate_poses(pictures, work, sensors, shown if plan.mask != "none" else None)
    cameras = {}
    for view in plan.views:
        camera = poses.cameras.get(view.name)
        if camera is None or camera.lens is None:
            continue
        raster = plan.recipes[view.sensor].calibration.raster
        whole = raster.lens_of_file(camera.lens, view.cube.shape[0], view.cube.shape[1])
        cameras[view.name] = replace(camera, lens=whole)
    return replace(poses, cameras=cameras)


def _picture(scene: Path, record: ViewRecord, shown: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    cube = map_array(scene / record.paths["hyperspectral_file_path"])
    height, width, bands = cube.shape
    weights = mean_weights(np.ones(bands, bool)) / FULL_SCALE
    return contrast_picture(lambda rows: cube[rows], (height, width), weights, shown)


def _shown(scene: Path, record: ViewRecord) -> Bool[np.ndarray, "H W"]:
    """Pixels of matter that were measured."""
    from PIL import Image

    with Image.open(scene / record.paths["file_path"]) as picture:
        shown = np.asarray(picture.convert("RGBA"))[..., 3] > 127
    if "mask_path" in record.paths:
        with Image.open(scene / record.paths["mask_path"]) as mask:
            shown = shown & (np.asarray(mask.convert("L")) > 0)
    return shown
