"""Bringing a run back from its folder: its config, its model alone, or the pipeline with its data."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.machine import resolve_device
from unmix_plugin.engine.model import Model
from unmix_plugin.engine.pipeline import Pipeline
from unmix_plugin.engine.registry import find_method
from unmix_plugin.engine.runs.checkpoints import (
    MODEL,
    Checkpoint,
    TrainingRecord,
    newest_complete_checkpoint,
    part,
    restore_model,
)
from unmix_plugin.engine.runs.config_json import config_from_json, config_to_json, flattened
from unmix_plugin.engine.runs.run_folder import RunFolder, open_run_folder
from unmix_plugin.engine.runs.run_json import read_run_json, write_run_json
from unmix_plugin.engine.runs.scene_record import SceneRecord, check_same_scene, read_scene_record
from unmix_plugin.errors import ConfigError, RunError, UnmixError, UnmixWarning, name_some


@dataclass(frozen=True)
class LoadedModel:
    """A trained model, brought back without its data."""

    folder: RunFolder
    config: TrainerConfig
    model: Model
    """On the device asked for, in evaluation mode, with the averaged parameters where the run has them."""
    record: SceneRecord
    training: TrainingRecord
    """How long it was trained."""


@dataclass(frozen=True)
class LoadedPipeline:
    """A trained model and its data."""

    folder: RunFolder
    config: TrainerConfig
    pipeline: Pipeline
    """Its model as in `LoadedModel`."""
    record: SceneRecord
    training: TrainingRecord


def load_model(path: Path, device: str = "auto") -> LoadedModel:
    """The newest complete checkpoint of a run as a model; reads nothing but the run folder.

    Raises:
        RunError: the run is missing, half-written, damaged, or from another version.
        ConfigError: the device is not there.
    """
    place = resolve_device(device)
    run, config, scene, checkpoint = _read_run(path)
    try:
        model = config.pipeline.model.setup(scene_box=scene.scene_box, metadata=scene.metadata)
    except (UnmixError, LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise RunError(f"config.json and scene.json in {run.path} describe no model: {error}") from error
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
    place = resolve_device(device)
    run, config, scene, checkpoint = _read_run(path)
    config = config if data is None else replace(config, data=data)
    pipeline: Pipeline = config.pipeline.setup(data=require_data(config), device=place, seed=config.seed)
    check_same_scene(scene, pipeline.datamanager, run)
    restore_model(checkpoint.tensors, pipeline.model, averaged=True)
    return LoadedPipeline(run, config, pipeline.eval(), scene, TrainingRecord.from_json(checkpoint.record))


def _read_run(path: Path) -> tuple[RunFolder, TrainerConfig, SceneRecord, Checkpoint]:
    """All that the folder of a run holds for its model, with a warning where newer checkpoints are damaged; what a
    model would take too much memory for is refused before it is made. Raises RunError."""
    run = open_run_folder(path)
    config = read_config(run)
    scene = read_scene_record(run, config.pipeline.datamanager.target)
    checkpoint = newest_complete_checkpoint(run.checkpoints)
    if checkpoint.damaged:
        passed_over = "; ".join(checkpoint.damaged)
        message = f"{run.path} is shown as it was after step {checkpoint.step}: passed over {passed_over}"
        warnings.warn(message, UnmixWarning, stacklevel=3)
    try:
        config.pipeline.model.target.check_tensors(scene.metadata, part(checkpoint.tensors, MODEL))
    except (UnmixError, LookupError, TypeError, ValueError) as error:
        raise RunError(
            f"the checkpoint does not fit the model that config and scene describe: {error}; train again"
        ) from error
    return run, config, scene, checkpoint


def load_config(path: Path) -> TrainerConfig:
    """The settings of the run at `path`, with `load_run` set to it: `Trainer(load_config(path))` resumes.

    Raises:
        RunError: the run is missing, half-written or from another version, its settings lack some or do not fit the
            method, or the method is not installed.
    """
    return read_config(open_run_folder(path))


def read_config(run: RunFolder) -> TrainerConfig:
    """The same of a run that is open."""
    stored = read_run_json(run.config_path).get("config")
    name = stored.get("method_name") if isinstance(stored, dict) else None
    try:
        config = config_from_json(stored, find_method(str(name)).config)
    except ConfigError as error:
        raise RunError(f"can't use the settings in {run.config_path}: {error}") from error
    if missing := sorted(flattened(config_to_json(config)).keys() - flattened(stored or {}).keys()):
        raise RunError(
            f"{run.config_path} lacks {name_some(missing)}: it is damaged, or of another version of the method; add "
            "what the run was trained with, or train again"
        )
    return replace(config, load_run=run.path)


def write_config(run: RunFolder, config: TrainerConfig) -> None:
    """Write `config.json`."""
    write_run_json(run.config_path, {"config": config_to_json(replace(config, load_run=None))})


def require_data(config: TrainerConfig) -> Path:
    """The scene's path. Raises ConfigError: none was given."""
    if config.data is None:
        raise ConfigError("no scene: give its folder with --data")
    return config.data
