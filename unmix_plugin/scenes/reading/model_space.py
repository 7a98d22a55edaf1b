"""Model space of a scene: which box the training views show, and whether the world goes on behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.focus import meeting_point
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.matched_points import MatchedPoints, find_matched_points
from unmix_plugin.scenes.geometry.pose_check import commonest, compare_conventions, describe
from unmix_plugin.scenes.geometry.thinned_views import ReadView
from unmix_plugin.scenes.geometry.world_evidence import find_world_evidence
from unmix_plugin.scenes.reading.cube_values import read_cube
from unmix_plugin.scenes.reading.frame_files import CheckedFiles
from unmix_plugin.scenes.reading.scene_cameras import make_cameras, world_poses
from unmix_plugin.scenes.reading.transforms_json import SceneEntry
from unmix_plugin.scenes.scene import Normalisation, SceneOptions


def find_model_space(
    root: Path, entry: SceneEntry, checked: CheckedFiles, train: tuple[int, ...], options: SceneOptions
) -> tuple[Normalisation, SceneBox, bool]:
    """The box that the training views show, how its longest edge becomes [-1, 1], and whether the world goes on.

    The similarity starts from the space of transforms.json. The box is found in a space centred on the training
    cameras, where coordinates are of order 1.

    Raises:
        SceneError: alpha and poses contradict.
    """
    cubes = list(checked.cube_hashes)
    first = _centred_on(world_poses(entry)[list(train), :, 3])
    cameras = make_cameras(entry, checked.sizes, first)[list(train)]
    foreground = None if checked.foreground is None else [checked.foreground[index] for index in train]
    alike = commonest([checked.sensor_indices[index] for index in train])

    def read_view(view: int, part: tuple[slice, ...]) -> Float32[np.ndarray, "H W B"]:
        return read_cube(cubes[train[alike[view]]], options.value_scale, options.invalid_pixels, part)

    points = None
    if foreground is None and meeting_point(cameras.camera_to_world.double().numpy()) is None:
        points = _matched_points(cameras, alike, read_view)
    try:
        first_box = find_bounds(root, cameras, foreground, points)
    except SceneError as error:
        alike_poses = world_poses(entry)[[train[row] for row in alike]]
        hint = describe(compare_conventions(alike_poses, cameras[alike], read_view))
        raise SceneError(f"{error}\n{hint}" if hint else str(error)) from error
    is_unbounded = options.world == "unbounded"
    if options.world == "auto" and foreground is None and not (points and points.are_equally_far):
        is_unbounded = find_world_evidence(first_box, cameras[alike], read_view).goes_on
    low, high = first_box.aabb.double().numpy()
    scale = float(2.0 / (high - low).max())
    half = 0.5 * scale * (high - low)
    translation = first.translation - 0.5 * (low + high) / first.scale
    box = SceneBox(torch.from_numpy(np.stack([-half, half])).float())
    return Normalisation(first.rotation, translation, first.scale * scale), box, is_unbounded


def _centred_on(positions: np.ndarray) -> Normalisation:
    """A space in which the farthest of these (N, 3) is 1 from their middle, the origin."""
    middle = positions.mean(axis=0)
    radius = float(np.linalg.norm(positions - middle, axis=-1).max())
    return Normalisation(np.eye(3), -middle, 1.0 / radius if radius > 0.0 else 1.0)


def _matched_points(cameras: Cameras, alike: Sequence[int], read_view: ReadView) -> MatchedPoints | None:
    """Places that views of one sensor agree on, by the numbers of all cameras."""
    found = find_matched_points(cameras[list(alike)], read_view)
    return None if found is None else replace(found, views=torch.tensor(alike)[found.views])
