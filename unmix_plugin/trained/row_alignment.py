"""Poses of an evaluation view's rows, fitted to its picture with the field as it is, where training corrected poses.

A line camera's rows wobble, so no single turn and shift aligns such a view. Once these are found (pose_alignment.py),
its rows are fitted one by one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.poses.row_fitting import fit_rows
from unmix_plugin.trained.pose_alignment import align_pose

if TYPE_CHECKING:
    from unmix_plugin.trained.evaluation import ViewTruth
    from unmix_plugin.trained.trained_scene import TrainedScene


@torch.no_grad()
def align_rows(scene: TrainedScene, camera: Cameras, truth: ViewTruth) -> Cameras:
    """A line camera, its rows moved to where the scene looks most like what was measured."""

    def look(rays: RayBundle, axes: Float[Tensor, "b C"]) -> Float[Tensor, "R D"]:
        matrix = axes if truth.sensor is None else torch.from_numpy(truth.sensor.matrix).to(axes).T @ axes
        found = scene.renderer.composite(scene.field, rays)
        seen = scene.materials.through(found, matrix)
        return seen if truth.alpha is None else torch.cat([seen, found.accumulation[:, None]], dim=1)

    turned = align_pose(scene, camera, truth).to(scene.device)
    return fit_rows(turned, truth.spectra, truth.valid, truth.alpha, scene.scene_box, look)
