"""`scene.json`: what a run keeps of its scene, validated when it is read."""

from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import torch

from unmix_plugin.engine.data_manager import DataManager
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.engine.runs.run_files import read_run_json
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.same_scene import differences, name_differences
from unmix_plugin.errors import ConfigError, RunError


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
    """What `scene.json` holds."""
    return {
        "scene_box": datamanager.scene_box.aabb.tolist(),
        "metadata": datamanager.metadata(),
        "train_cameras": datamanager.train_cameras.to_json(),
        "eval_cameras": datamanager.eval_cameras.to_json(),
        "summary": datamanager.summary(),
    }


def read_scene_record(run: RunFolder, kind: type[DataManager] = DataManager) -> SceneRecord:
    """Read `scene.json`.

    Args:
        kind: The data manager that wrote it, which checks its own part.
    Raises:
        RunError: it is missing, damaged or from another version.
    """
    values = read_run_json(run.scene_path)
    try:
        metadata, summary = _dictionary(values, "metadata"), _dictionary(values, "summary")
        record = SceneRecord(
            SceneBox(torch.tensor(values["scene_box"], dtype=torch.float32).reshape(2, 3)),
            metadata,
            Cameras.from_json(values["train_cameras"]),
            Cameras.from_json(values["eval_cameras"]),
            summary,
        )
        _check_frames(record)
        kind.check_record(metadata, summary)
    except (LookupError, TypeError, ValueError, RuntimeError, OverflowError, ConfigError) as error:
        raise RunError(f"{run.scene_path} is damaged: {type(error).__name__}: {error}") from error
    return record


def check_same_scene(scene: SceneRecord, datamanager: DataManager, run: RunFolder) -> None:
    """Refuse another scene than the run's; numbers may differ by what machines round differently.

    Raises:
        RunError: metadata, scene box or identity differ from what the run was trained with.
    """
    kept = {
        **scene.metadata,
        "scene_box": scene.scene_box.aabb.tolist(),
        **datamanager.identity(scene.summary),
    }
    found = {
        **datamanager.metadata(),
        "scene_box": datamanager.scene_box.aabb.tolist(),
        **datamanager.identity(datamanager.summary()),
    }
    differing = differences(kept, found)
    if differing:
        raise RunError(
            f"the scene at {datamanager.data} is not the one that {run.path} was trained on: "
            f"{name_differences(differing)}; name the right one with --data"
        )


def _dictionary(values: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(values[name], dict):
        raise TypeError(f"{name} must be an object; found {type(values[name]).__name__}")
    return values[name]


def _check_frames(record: SceneRecord) -> None:
    """Names of views become names of files."""
    summary = record.summary
    if "frames" not in summary:
        return
    frames = summary["frames"]
    if not isinstance(frames, list) or len(set(map(str, frames))) != len(frames):
        raise ValueError("frames must be a list of different names")
    for name in frames:
        if not is_plain_name(name):
            raise ValueError(f"{name!r} can't be the name of a frame: it is not a plain file name")
    for split, cameras in (("train", record.train_cameras), ("eval", record.eval_cameras)):
        indices = summary.get(f"{split}_indices", [])
        if not isinstance(indices, list) or len(indices) not in (0, len(cameras)):
            raise ValueError(f"{split}_indices must be a list with an entry for each of {len(cameras)} views")
        if not all(type(index) is int and 0 <= index < len(frames) for index in indices):
            raise ValueError(f"{split}_indices must count from 0 to {len(frames) - 1}")


def is_plain_name(name: Any) -> bool:
    """Whether `name` is text that names a file in a folder, and never one elsewhere."""
    if not isinstance(name, str) or name in ("", ".", ".."):
        return False
    return PurePath(name).name == name and all(character >= " " for character in name)
