"""Cameras and model space of a scene: which box the training views show, and whether the world goes on behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.focus import meeting_point
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.matched_points import MatchedPoints, find_matched_points
from unmix_plugin.scenes.geometry.pose_check import ReadView, commonest, compare_conventions, describe
from unmix_plugin.scenes.geometry.world_evidence import find_world_evidence
from unmix_plugin.scenes.reading.cubes import read_cube
from unmix_plugin.scenes.reading.images import Size
from unmix_plugin.scenes.reading.loader import CheckedFiles
from unmix_plugin.scenes.reading.transforms_json import Intrinsics, SceneEntry
from unmix_plugin.scenes.scene import Normalisation, SceneOptions


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
