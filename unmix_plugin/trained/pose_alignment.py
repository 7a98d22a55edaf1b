"""The pose of an evaluation view, fitted to its picture with the field as it is, where training corrected poses.

Corrected poses and field move together, so a given pose no longer says exactly from where a view was taken. As is usual
for fields that refine poses, each evaluation view is aligned before it is measured: one turn and one shift are found
with which the field shows it best, coarse pictures first. Nothing of the field changes.

Notation: `P` pixels of a coarse picture, `C` spectral channels compared, `D` those and opacity.

Source: Lin et al. 2021, BARF (alignment of views at test time); here by Levenberg-Marquardt steps with differences of
renders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.rotations import rotation_matrix
from unmix_plugin.pose_refinement import LARGEST_STEP

if TYPE_CHECKING:
    from unmix_plugin.trained.evaluation import ViewTruth
    from unmix_plugin.trained.trained_scene import TrainedScene

SIDES_PX = (24, 48, 96, 192)
"""Longest sides of the pictures compared, one after the other; none larger than the view."""
STEPS = (5, 3, 2, 1)
"""Steps taken on each."""
_CHANNELS = 3
_DAMPING = 1e-3
_DIFFERENCE_PX = 0.5
_SMALLEST_STEP_PX = 0.05
"""Below which no further step is taken on a picture."""

Residuals = Callable[[Float[Tensor, "6"]], Float[Tensor, " n"]]


@torch.no_grad()
def align_pose(scene: TrainedScene, camera: Cameras, truth: ViewTruth) -> Cameras:
    """The camera, moved to where the scene looks most like what was measured; one camera, of a frame or of lines."""
    axes = _channels(truth)
    step = torch.zeros(6)
    for side, count in zip(SIDES_PX, STEPS, strict=True):
        if side > max(camera.width, camera.height) and side > SIDES_PX[0]:
            break
        small = _shrunk(camera, side)
        wanted, counts = _pooled(truth, axes, small)
        focal = float(small.focal_px.mean())

        def residuals(
            x: Float[Tensor, "6"], small: Cameras = small, wanted: Tensor = wanted, counts: Tensor = counts
        ) -> Float[Tensor, " n"]:
            seen = _shown(scene, moved(small, x, scene), truth, axes)
            return ((seen - wanted) * counts).flatten()

        step = _fit(residuals, step, count, _DIFFERENCE_PX / focal)
    return moved(camera, step, scene)


def moved(camera: Cameras, step: Float[Tensor, "6"], scene: TrainedScene) -> Cameras:
    """A camera that is turned about itself and shifted, by a share of its distance to the scene's middle."""
    middle = scene.scene_box.aabb.mean(dim=0).to(camera.camera_to_world)
    reach = (camera.camera_to_world[0, :, 3] - middle).norm()
    turn, shift = rotation_matrix(step[:3]).to(middle), (step[3:].to(middle) * reach)[:, None]

    def change(poses: Float[Tensor, "n 3 4"]) -> Float[Tensor, "n 3 4"]:
        return torch.cat([turn @ poses[:, :, :3], poses[:, :, 3:] + shift], dim=-1)

    keys = camera.key_poses
    return replace(
        camera,
        camera_to_world=change(camera.camera_to_world),
        key_poses=None if keys is None else replace(keys, poses=change(keys.poses)),
    )


def _fit(
    residuals: Residuals, start: Float[Tensor, "6"], count: int, difference: float
) -> Float[Tensor, "6"]:
    """Levenberg-Marquardt steps from `start` that each lower the sum of squares, within `LARGEST_STEP`."""
    best, found = start, residuals(start)
    damping = _DAMPING
    for _ in range(count):
        columns = [residuals(best + difference * axis) - found for axis in torch.eye(6)]
        slopes = torch.stack(columns, dim=1).double() / difference
        normal, pull = slopes.T @ slopes, slopes.T @ found.double()
        for _ in range(3):
            ridge = damping * normal.diagonal().mean().clamp(min=1e-12) * torch.eye(6, dtype=torch.float64)
            tried = best - torch.linalg.solve(normal + ridge, pull).float()
            tried = tried.clamp(-LARGEST_STEP, LARGEST_STEP)
            seen = residuals(tried)
            if float(seen.square().sum()) < float(found.square().sum()):
                change = float((tried - best).norm()) / difference * _DIFFERENCE_PX
                best, found, damping = tried, seen, damping / 3
                if change < _SMALLEST_STEP_PX:
                    return best
                break
            damping *= 10
        else:
            return best
    return best


def _channels(truth: ViewTruth) -> Float[Tensor, "B C"]:
    """The few directions in which the spectra of a view vary most."""
    spectra = truth.spectra[truth.valid].float()
    _, _, axes = torch.linalg.svd(spectra[:: max(1, len(spectra) // 20_000)], full_matrices=False)
    return axes[:_CHANNELS].T


def _shrunk(camera: Cameras, side: int) -> Cameras:
    """The same view in fewer pixels; both edges shrink by about as much."""
    share = min(1.0, side / max(camera.width, camera.height))
    width, height = max(1, round(share * camera.width)), max(1, round(share * camera.height))
    scale = camera.focal_px.new_tensor([width / camera.width, height / camera.height])
    keys = camera.key_poses
    return replace(
        camera,
        focal_px=camera.focal_px * scale,
        center_px=camera.center_px * scale,
        width=width,
        height=height,
        key_poses=None if keys is None else keys.with_heights(keys.heights * scale[1]),
    )


def _pooled(
    truth: ViewTruth, axes: Float[Tensor, "B C"], small: Cameras
) -> tuple[Float[Tensor, "P D"], Float[Tensor, "P 1"]]:
    """What was measured in the pixels of a smaller picture, and which share of each counts."""
    alpha = truth.opacity.float()[..., None]
    values = torch.cat([truth.spectra.float() @ axes, alpha], dim=-1) * truth.valid[..., None]
    both = torch.cat([values, truth.valid[..., None].float()], dim=-1).permute(2, 0, 1)[None]
    found = torch.nn.functional.adaptive_avg_pool2d(both, (small.height, small.width))[0].flatten(1).T
    return found[:, :-1] / found[:, -1:].clamp(min=1e-6), found[:, -1:]


def _shown(
    scene: TrainedScene, camera: Cameras, truth: ViewTruth, axes: Float[Tensor, "B C"]
) -> Float[Tensor, "P D"]:
    view = scene.look(camera, 2 if max(camera.width, camera.height) <= SIDES_PX[0] else 1)
    opacity = view.opacity if truth.alpha is not None else torch.ones_like(view.opacity)
    seen = truth.seen(view["spectral"]).float() @ axes.to(view.opacity)
    return torch.cat([seen, opacity[..., None]], dim=-1).flatten(0, 1).cpu()
