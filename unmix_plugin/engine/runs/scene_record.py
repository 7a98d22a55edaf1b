"""`scene.json`: what a run keeps of its scene, validated when it is read and compared with the scene of a command.

Two descriptions of a scene mean the same if they are equal but for numbers, which machines round differently.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import torch

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.model import DataManager
from unmix_plugin.engine.runs.atomic_files import NOT_PORTABLE, safe_name
from unmix_plugin.engine.runs.config_json import flattened
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.run_json import parse_plain_json, read_run_json
from unmix_plugin.errors import ConfigError, RunError, name_some


@dataclass(frozen=True)
class SceneRecord:
    """What a run keeps of its scene."""

    scene_box: SceneBox
    """What the scene fits in."""
    metadata: dict[str, Any]
    """What gave the model its shape."""
    train_cameras: Cameras
    """Cameras of the training views."""
    eval_cameras: Cameras
    """Cameras of the evaluation views."""
    summary: dict[str, Any]
    """What the data manager said of the scene; `frames`, where it has them, are fit for file names."""


def scene_record_to_json(datamanager: DataManager) -> dict[str, Any]:
    """What `scene.json` holds. Raises ConfigError: something that it couldn't be read with."""
    values = {
        "scene_box": datamanager.scene_box.aabb.tolist(),
        "metadata": datamanager.metadata(),
        "train_cameras": datamanager.train_cameras.to_json(),
        "eval_cameras": datamanager.eval_cameras.to_json(),
        "summary": datamanager.summary(),
    }
    kind = type(datamanager)
    try:
        _record_of(parse_plain_json(json.dumps(values, allow_nan=False)), kind)
    except _MISFITS as error:
        raise ConfigError(f"no run can keep what {kind.__name__} says of the scene: {error}") from error
    return values


def read_scene_record(run: RunFolder, kind: type[DataManager] = DataManager) -> SceneRecord:
    """Read `scene.json`.

    Args:
        kind: The data manager that wrote it, which checks its own part.
    Raises:
        RunError: it is missing, damaged or from another version.
    """
    values = read_run_json(run.scene_path)
    try:
        return _record_of(values, kind)
    except _MISFITS as error:
        raise RunError(f"{run.scene_path} is damaged: {type(error).__name__}: {error}") from error


_MISFITS = (LookupError, TypeError, ValueError, RuntimeError, OverflowError, ConfigError)


class _Record(msgspec.Struct):
    """Entries of `scene.json`."""

    scene_box: tuple[tuple[float, float, float], tuple[float, float, float]]
    metadata: dict[str, Any]
    train_cameras: dict[str, Any]
    eval_cameras: dict[str, Any]
    summary: dict[str, Any]


class _Views(msgspec.Struct):
    """Entries of a summary that the engine reads: names of frames, and which of them are training and evaluation views;
    none where the data manager notes none."""

    frames: list[str] = []
    train_indices: list[int] = []
    eval_indices: list[int] = []


def _record_of(values: dict[str, Any], kind: type[DataManager]) -> SceneRecord:
    """The record that is written as these values by a data manager of that kind. Raises one of `_MISFITS`."""
    found = msgspec.convert(values, _Record)
    record = SceneRecord(
        SceneBox(torch.tensor(found.scene_box, dtype=torch.float32)),
        found.metadata,
        Cameras.from_json(found.train_cameras),
        Cameras.from_json(found.eval_cameras),
        found.summary,
    )
    if "frames" in found.summary:
        views = msgspec.convert(found.summary, _Views)
        if len(set(views.frames)) != len(views.frames):
            raise ValueError("frames must be a list of different names")
        for name in views.frames:
            if name != safe_name(name, NOT_PORTABLE):  # names of views become names of files
                raise ValueError(f"{name!r} can't be the name of a frame: it is not a plain file name")
        for split, indices, cameras in (
            ("train", views.train_indices, record.train_cameras),
            ("eval", views.eval_indices, record.eval_cameras),
        ):
            if len(indices) not in (0, len(cameras)):
                raise ValueError(f"{split}_indices must have an entry for each of {len(cameras)} views")
            if not all(0 <= index < len(views.frames) for index in indices):
                raise ValueError(f"{split}_indices must count from 0 to {len(views.frames) - 1}")
    kind.check_record(found.metadata, found.summary)
    return record


def check_same_scene(scene: SceneRecord, datamanager: DataManager, run: RunFolder) -> None:
    """Refuse another scene than the run's; numbers may differ by what machines round differently. Raises RunError:
    metadata, scene box, cameras or identity differ from what the run was trained with."""
    box, other_box = scene.scene_box.aabb.tolist(), datamanager.scene_box.aabb.tolist()
    cameras, other_cameras = (
        {"training cameras": one.train_cameras.to_json(), "evaluation cameras": one.eval_cameras.to_json()}
        for one in (scene, datamanager)
    )
    kept = {**scene.metadata, "scene_box": box, **datamanager.identity(scene.summary), **cameras}
    found = {**datamanager.metadata(), "scene_box": other_box, **datamanager.identity(datamanager.summary())}
    differing = differences(kept, {**found, **other_cameras})
    if differing:
        raise RunError(
            f"the scene at {datamanager.data} is not the one that {run.path} was trained on: "
            f"{name_differences(differing)}; name the right one with --data"
        )


_RELATIVE_TOLERANCE = 1e-4
"""Of numbers, against the greatest of the list that they are in."""


def differences(expected: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """What differs between nested JSON-like values, each as the name of its place; empty if nothing does.

    >>> differences({"size": [64, 48], "box": 1.0}, {"size": [64, 32], "box": 1.0 + 1e-9})
    ['size']
    """
    one, other = flattened(expected), flattened(found)
    names = dict.fromkeys([*one, *other])
    return [x for x in names if x not in one or x not in other or not _agree(one[x], other[x])]


def name_differences(places: list[str]) -> str:
    """Differences for a message, the first ones by name.

    >>> name_differences(["cameras", "frames"])
    'cameras, frames differ'
    """
    return name_some(places, most=5) + " differ"


def _agree(expected: Any, found: Any) -> bool:
    if isinstance(expected, Mapping) and isinstance(found, Mapping):
        return not differences(expected, found)
    a, b = _as_numbers(expected), _as_numbers(found)
    if a is not None and b is not None:
        if a.shape != b.shape:
            return False
        scale = max(float(np.abs(a).max(initial=0.0)), float(np.abs(b).max(initial=0.0)))
        return bool((np.abs(a - b) <= _RELATIVE_TOLERANCE * scale).all())
    if isinstance(expected, list | tuple) and isinstance(found, list | tuple):
        return len(expected) == len(found) and all(map(_agree, expected, found))
    return type(expected) is type(found) and expected == found


def _as_numbers(value: Any) -> np.ndarray | None:
    """A number, or an array of numbers of any shape; None for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None
