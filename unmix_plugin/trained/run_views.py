"""What a run's record says of its scene: the views, and the way from the scene's own world to model space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.errors import ConfigError, RunError, did_you_mean
from unmix_plugin.scenes.scene import Normalisation

ViewChoice = Literal["eval", "train", "all"]
"""Evaluation views, training views, or the ones and then the others."""


@dataclass(frozen=True)
class RunView:
    """One view of the scene that a run was trained on."""

    name: str
    """Unique in the scene, fit for file names."""
    camera: Cameras
    """One camera, model space."""
    split: Literal["train", "eval"] = "eval"
    """Whether it was trained on."""


def recorded_views(record: SceneRecord) -> tuple[RunView, ...]:
    """Training views, then evaluation views, named as the scene's frames are; `eval_000` where the data manager has
    noted no names."""
    views = []
    splits: tuple[tuple[Literal["train", "eval"], Cameras], ...]
    splits = ("train", record.train_cameras), ("eval", record.eval_cameras)
    for split, cameras in splits:
        names = [f"{split}_{number:03d}" for number in range(len(cameras))]
        frames, indices = record.summary.get("frames"), record.summary.get(f"{split}_indices")
        if isinstance(frames, list) and isinstance(indices, list) and len(indices) == len(cameras):
            names = [str(frames[index]) for index in indices]
        views += [RunView(name, cameras[number], split) for number, name in enumerate(names)]
    return tuple(views)


def find_view(numbered: Sequence[RunView], wanted: str, others: Sequence[RunView] = ()) -> RunView:
    """A view by its name, or by its number from 0 in `numbered`; `others` can be had by name only."""
    by_name = {view.name: view for view in (*others, *numbered)}
    if wanted in by_name:
        return by_name[wanted]
    if wanted.isdecimal() and int(wanted) < len(numbered):
        return numbered[int(wanted)]
    hint = did_you_mean(wanted, list(by_name), likeness=0.4, form=" ({})")
    numbers = f"a number from 0 to {len(numbered) - 1}, or " if numbered else ""
    known = [view.name for view in (*numbered, *others)]
    advice = f"give {numbers}a name such as {known[0]}" if known else "the run has none"
    raise ConfigError(f"no view {wanted!r}{hint}; {advice}")


def views_of(views: Sequence[RunView], choice: ViewChoice) -> list[RunView]:
    """The views chosen, evaluation views first."""
    splits = ("eval", "train") if choice == "all" else (choice,)
    return [view for split in splits for view in views if view.split == split]


def some_views_of(views: Sequence[RunView], choice: Literal["eval", "train"]) -> list[RunView]:
    """The same, of which there has to be one; a ConfigError where a run has none."""
    chosen = views_of(views, choice)
    if not chosen:
        missing, other = ("evaluation", "train") if choice == "eval" else ("training", "eval")
        raise ConfigError(
            f"the run has no {missing} views; choose --cameras dataset-{other} or a camera file"
        )
    return chosen


def cameras_of(views: Sequence[RunView], choice: Literal["eval", "train"]) -> Cameras:
    """The cameras of the views chosen, as one; a ConfigError where there is none."""
    chosen = [view.camera for view in some_views_of(views, choice)]
    return Cameras.of_sizes(
        torch.cat([camera.camera_to_world for camera in chosen]),
        torch.cat([camera.focal_px for camera in chosen]),
        torch.cat([camera.center_px for camera in chosen]),
        torch.cat([camera.distortion for camera in chosen]),
        [camera.size(0) for camera in chosen],
    )


def resized_views(views: Sequence[RunView], size: tuple[int, int] | None = None) -> tuple[RunView, ...]:
    """The views with pictures of this width and height; None: as large as the largest, which is a rig's sharpest."""
    chosen = max((view.camera.size(0) for view in views), key=math.prod) if size is None else size
    return tuple(
        view if view.camera.size(0) == chosen else replace(view, camera=view.camera.resized(*chosen))
        for view in views
    )


_LEAST_UPWARD, _LOOKING_DOWN = 0.3, 0.8
"""Length of the mean upward axis that tells what is up; height of the mean viewing axis that tells a flight."""


def up_direction(cameras: Cameras) -> tuple[float, float, float]:
    """What is up in model space: the cameras' mean upward axis, or the axis of model space that it nearly is; +z where
    cameras look down on average, as in flights, or upward axes cancel."""
    mean, back = (cameras.camera_to_world[:, :, axis].double().mean(dim=0) for axis in (1, 2))
    length = float(mean.norm())
    if length < _LEAST_UPWARD or abs(float(back[2])) > _LOOKING_DOWN:
        return (0.0, 0.0, 1.0)
    up = (mean / length).cpu().numpy()
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > math.cos(math.radians(20)):
        up = np.eye(3)[axis] * np.sign(up[axis])
    return (float(up[0]), float(up[1]), float(up[2]))


def world_up(views: Sequence[RunView], frame: Normalisation) -> Float64[np.ndarray, "3"]:
    """What is up in the world of the scene, a unit vector, from its training views."""
    up = np.asarray(up_direction(cameras_of(views, "train")), dtype=np.float64)
    return directions_to_world(frame, up)


_PRECISION = 1e-6
"""Of positions in files, as a part of the extent of what is exported."""


def world_frame(scene: SceneRecord) -> Normalisation:
    """How a run's world became its model space; one that changes nothing where the run has recorded none. A RunError
    where the record is damaged."""
    recorded = scene.summary.get("normalisation")
    if recorded is None:
        return Normalisation(np.eye(3), np.zeros(3), 1.0)
    try:
        return Normalisation.from_json(recorded)
    except ValueError as error:
        raise RunError(
            f"the run's scene.json is damaged: its normalisation is {recorded!r} ({error}); train again"
        ) from error


def positions_for_files(
    world: Float64[np.ndarray, "*points 3"],
) -> Float32[np.ndarray, "*points 3"] | Float64[np.ndarray, "*points 3"]:
    """World positions in the type that files need: float32 where it keeps them to a millionth of their extent; others,
    such as geo-referenced ones, stay float64."""
    if world.size == 0:
        return world.astype(np.float32)
    extent = float(np.ptp(world.reshape(-1, 3), axis=0).max())
    rounding = 0.5 * float(np.spacing(np.float32(np.abs(world).max())))
    return world if rounding > _PRECISION * extent else world.astype(np.float32)


def gltf_positions(
    world: Float[np.ndarray, "*points 3"],
) -> tuple[Float32[np.ndarray, "*points 3"], dict[str, list[float]]]:
    """Positions of `positions_for_files` as float32, which glTF has alone, and what its extras say: the `offset` that
    was taken from large ones."""
    if world.dtype != np.float64:
        return world.astype(np.float32), {}
    extent = max(float(np.ptp(world, axis=0).max()), 1e-12)
    # Whole units, or as many digits as leave no more than about the extent, which float32 resolves.
    offset = np.round(world.mean(axis=0), max(0, -math.floor(math.log10(extent))))
    return (world - offset).astype(np.float32), {"offset": offset.tolist()}


def directions_to_world(
    frame: Normalisation, directions: Float[np.ndarray, "*points 3"]
) -> Float64[np.ndarray, "*points 3"]:
    """Directions of model space in the world: turned back, lengths kept."""
    return directions @ frame.rotation


def affine_to_world(
    frame: Normalisation, origin: Float[np.ndarray, "3"], cell: float
) -> Float64[np.ndarray, "4 4"]:
    """Matrix from indices of a model-space grid, as (i, j, k, 1), to world points; `origin` is that of (0, 0, 0)."""
    matrix = np.eye(4)
    matrix[:3, :3] = frame.rotation.T * (cell / frame.scale)
    matrix[:3, 3] = frame.to_world(np.asarray(origin, dtype=np.float64))
    return matrix
