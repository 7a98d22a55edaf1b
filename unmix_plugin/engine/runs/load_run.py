"""Bringing a run back from its folder: its config, its model alone, or the pipeline with its data."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from unmix_plugin.atomic_files import read_json, write_json_atomically
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.data_manager import DataManager
from unmix_plugin.engine.devices import resolve_device
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.engine.model import Model
from unmix_plugin.engine.pipeline import Pipeline
from unmix_plugin.engine.registry import find_method
from unmix_plugin.engine.runs.checkpoints import Checkpoint, newest_complete_checkpoint
from unmix_plugin.engine.runs.config_json import config_from_json, config_to_json
from unmix_plugin.engine.runs.run_folder import RunFolder, open_run_folder
from unmix_plugin.engine.training.training_state import TrainingRecord, restore_model
from unmix_plugin.errors import ConfigError, RunError

CONFIG_FORMAT_VERSION = 1
SCENE_FORMAT_VERSION = 1


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
    """What the data manager said of the scene."""


@dataclass(frozen=True)
class LoadedModel:
    """A trained model, brought back without its data."""

    run: RunFolder
    config: TrainerConfig
    model: Model
    """On the device asked for, in evaluation mode, with the averaged parameters where the run has them."""
    scene: SceneRecord
    training: TrainingRecord
    """How long it was trained."""


@dataclass(frozen=True)
class LoadedPipeline:
    """A trained model and its data."""

    run: RunFolder
    config: TrainerConfig
    pipeline: Pipeline
    """Its model as in `LoadedModel`."""
    scene: SceneRecord
    training: TrainingRecord

    @property
    def step(self) -> int:
        """Training steps done."""
        return self.training.steps


def load_model(path: Path, device: str = "auto") -> LoadedModel:
    """The newest complete checkpoint of a run as a model; reads nothing but the run folder.

    Raises:
        RunError: the run is missing, half-written, damaged, or from a newer version.
        ConfigError: the device is not there.
    """
    run, place = open_run_folder(path), resolve_device(device)
    config, scene = load_config(path), read_scene_record(run)
    checkpoint = require_checkpoint(run)
    model: Model = config.pipeline.model.setup(scene_box=scene.scene_box, metadata=scene.metadata)
    restore_model(checkpoint.tensors, model, averaged=True)
    record = TrainingRecord.from_json(checkpoint.record)
    return LoadedModel(run, config, model.to(place).eval(), scene, record)


def load_pipeline(path: Path, device: str = "auto", data: Path | None = None) -> LoadedPipeline:
    """The same with the data it was trained on, or with the same scene at `data` if it has moved.

    Raises:
        RunError: as `load_model`, or the scene is not the one the run was trained on.
        SceneError: the scene is missing or malformed.
        ConfigError: the device is not there.
    """
    run, place = open_run_folder(path), resolve_device(device)
    config, scene = load_config(path), read_scene_record(run)
    checkpoint = require_checkpoint(run)
    config = config if data is None else replace(config, data=data)
    pipeline: Pipeline = config.pipeline.setup(data=require_data(config), device=place, seed=config.seed)
    check_same_scene(scene, pipeline.datamanager, run)
    restore_model(checkpoint.tensors, pipeline.model, averaged=True)
    return LoadedPipeline(run, config, pipeline.eval(), scene, TrainingRecord.from_json(checkpoint.record))


def load_config(path: Path) -> TrainerConfig:
    """The settings of the run at `path`, with `load_run` set to it: `Trainer(load_config(path))` resumes.

    Raises:
        RunError: the run is missing, half-written or from a newer version, its settings do not fit the method, or the
            method is not installed.
    """
    run = open_run_folder(path)
    values = read_json(run.config_path, CONFIG_FORMAT_VERSION)
    stored = values.get("config")
    name = stored.get("method_name") if isinstance(stored, dict) else None
    try:
        config = config_from_json(stored, find_method(str(name)).config)
    except ConfigError as error:
        raise RunError(f"can't use the settings in {run.config_path}: {error}") from error
    return replace(config, load_run=run.path)


def write_config(run: RunFolder, config: TrainerConfig) -> None:
    """Write `config.json`.

    Raises:
        RunError: the disk is full or refuses.
    """
    values = config_to_json(replace(config, load_run=None))
    write_json_atomically(run.config_path, {"format_version": CONFIG_FORMAT_VERSION, "config": values})


def scene_record_to_json(datamanager: DataManager) -> dict[str, Any]:
    """What `scene.json` holds."""
    return {
        "format_version": SCENE_FORMAT_VERSION,
        "scene_box": datamanager.scene_box.aabb.tolist(),
        "metadata": datamanager.metadata(),
        "train_cameras": datamanager.train_cameras.to_json(),
        "eval_cameras": datamanager.eval_cameras.to_json(),
        "summary": datamanager.summary(),
    }


def read_scene_record(run: RunFolder) -> SceneRecord:
    """Read `scene.json`.

    Raises:
        RunError: it is missing, damaged or from a newer version.
    """
    values = read_json(run.scene_path, SCENE_FORMAT_VERSION)
    try:
        return SceneRecord(
            SceneBox(torch.tensor(values["scene_box"], dtype=torch.float32)),
            values["metadata"],
            Cameras.from_json(values["train_cameras"]),
            Cameras.from_json(values["eval_cameras"]),
            values["summary"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{run.scene_path} is damaged: {type(error).__name__} {error}") from error


def require_checkpoint(run: RunFolder) -> Checkpoint:
    """The newest complete checkpoint.

    Raises:
        RunError: there is none.
    """
    checkpoint = newest_complete_checkpoint(run.checkpoints)
    if checkpoint is None:
        raise RunError(
            f"no complete checkpoint in {run.checkpoints}: training ended before the first was saved"
        )
    return checkpoint


def require_data(config: TrainerConfig) -> Path:
    """The scene's path.

    Raises:
        ConfigError: none was given.
    """
    if config.data is None:
        raise ConfigError("no scene: give its folder with --data")
    return config.data


def check_same_scene(scene: SceneRecord, datamanager: DataManager, run: RunFolder) -> None:
    """Refuse data that would give the model another shape or another space.

    Raises:
        RunError: metadata or scene box differ from what the run was trained with.
    """
    found = json.loads(json.dumps(datamanager.metadata()))  # as it would be read back: tuples become lists
    differing = sorted(key for key in {*scene.metadata, *found} if scene.metadata.get(key) != found.get(key))
    # Another machine's linear algebra may differ in the last bits of a box that is computed from the cameras.
    if not torch.allclose(scene.scene_box.aabb, datamanager.scene_box.aabb.cpu(), rtol=1e-4):
        differing.append("scene_box")
    if differing:
        raise RunError(
            f"the scene at {datamanager.data} is not the one that {run.path} was trained on: "
            f"{', '.join(differing)} differ; name the right one with --data"
        )
