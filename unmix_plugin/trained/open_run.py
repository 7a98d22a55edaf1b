"""Opening a run: from its folder, or a model in training, to its trained scene; and finding the measured scene."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.model import Model
from unmix_plugin.engine.registry import discover_methods, find_method
from unmix_plugin.engine.runs.checkpoints import TrainingRecord
from unmix_plugin.engine.runs.loading import SceneRecord, load_model, read_config
from unmix_plugin.engine.runs.run_folder import RunFolder, open_run_folder
from unmix_plugin.engine.runs.scene_record import differences, name_differences, read_scene_record
from unmix_plugin.errors import ConfigError, RunError, SceneError
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene, scene_identity
from unmix_plugin.settings import SceneOptions
from unmix_plugin.trained.measured_errors import read_errors
from unmix_plugin.trained.measures import Measures, Scale, read_measures, recorded_scale
from unmix_plugin.trained.model_scene import model_scene
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.run_views import recorded_views, world_frame
from unmix_plugin.trained.trained_scene import TrainedScene, with_cells
from unmix_plugin.trained.unexplained_map import read_unexplained_map


def unmix_scene(
    model: UnmixModel, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> TrainedScene:
    """The scene of a model as it is now; training that goes on does not change it.

    Cameras of the record are shown as they were corrected, those of evaluation views with the corrected lens. Errors
    are those of `world_frame` and `recorded_scale`.
    """
    frozen = model.frozen_parameters(averages)
    materials = model.materials
    specular = frozen.get(id(materials.specular_spectra), materials.specular_spectra)
    if model.poses is not None:
        own = copy.deepcopy(model.poses, frozen)  # type: ignore[arg-type]
        record = replace(
            record,
            train_cameras=own.refined(record.train_cameras),
            eval_cameras=own.corrected_lens(record.eval_cameras),
        )
    materials = replace(materials, endmembers=frozen[id(model.endmembers)], specular_spectra=specular)
    materials = materials.called_by_colour()
    gains = copy.deepcopy(model.view_gains, frozen)  # type: ignore[arg-type]
    views = torch.arange(model.metadata["num_train_views"], device=model.device)
    return TrainedScene(
        copy.deepcopy(model.field, frozen).eval(),  # type: ignore[arg-type]
        with_cells(model.renderer, torch.clone),
        materials.to(model.device),
        world_frame(record),
        recorded_views(record),
        model.metadata["pixel_size"],
        model.metadata["subpixels"],
        fitted=(
            *(["pose"] if model.poses is not None else []),
            *(["gain"] if model.view_gains is not None else []),
        ),
        scale=recorded_scale(record.summary),
        view_gains=None if gains is None else gains(views, gains.terms).cpu(),
    )


def snapshot(
    model: Model, method_name: str, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> RenderableScene:
    """The scene of a model of any method, as its registration makes it."""
    make = find_method(method_name).scene or model_scene
    return cast(RenderableScene, make(model, record, averages))


def find_scene(summary: Mapping[str, Any], run: Path, data: Path | None) -> Scene | None:
    """The scene of a run by the summary of its record, if it is where it was and has not changed.

    Raises:
        SceneError: it has to be at `data`, and is not, or malformed there.
        RunError: `data` is another scene than the run's.
    """
    root = data or Path(str(summary.get("root", "")))
    if data is None and not (root.is_absolute() and root.is_dir()):
        return None
    try:
        scene = load_scene(root, SceneOptions(**summary.get("options", {})))
    except (SceneError, ConfigError, TypeError):
        if data is None:
            return None
        raise
    differing = differences(scene_identity(summary), scene_identity(scene.summary()))
    if not differing:
        return scene
    if data is None:
        return None
    raise RunError(
        f"the scene at {root} is not the one that {run} was trained on: {name_differences(differing)}"
    )


@dataclass(frozen=True)
class LoadedRun:
    """A trained scene, and what its run folder says of how it came about."""

    folder: RunFolder
    config: TrainerConfig
    record: SceneRecord
    """What the run keeps of its input."""
    training: TrainingRecord
    scene: RenderableScene
    measures: Measures = Measures()
    """What a user measured in it."""

    @property
    def scale(self) -> Scale | None:
        """How long a unit of its world is, as it was set for the run, or else as its scene says; None where unknown."""
        return self.measures.scale or recorded_scale(self.record.summary)

    @property
    def scene_name(self) -> str:
        """What the run calls its scene: the name of its folder."""
        root = self.record.summary.get("root")
        return Path(str(root)).name if root else self.folder.path.parents[1].name

    @property
    def materials_scene(self) -> TrainedScene:
        """The scene, which must be one of mixed materials."""
        return require_materials(self.scene, self.config.method_name)


def load_run(path: str | Path, device: str = "auto") -> LoadedRun:
    """The newest complete checkpoint of a run; reads nothing but the run folder.

    Raises:
        RunError: the run is missing, half-written, damaged, or from a newer version.
        ConfigError: the device is not there, or the method is not installed.
    """
    loaded = load_model(Path(path), device)
    folder, record = loaded.folder, loaded.record
    scene = snapshot(loaded.model, loaded.config.method_name, record)
    run = LoadedRun(folder, loaded.config, record, loaded.training, scene, read_measures(folder))
    if not isinstance(scene, TrainedScene):
        return run
    shape = (len(scene.bands), len(scene.materials.names))
    errors = read_errors(folder.path, loaded.training.steps, *shape)
    scene = replace(
        scene,
        scale=run.scale,
        measured_errors=errors if isinstance(errors, str) else errors.map(lambda one: one.to(scene.device)),
        unexplained=read_unexplained_map(folder.path),
    )
    return replace(run, scene=scene)


def open_run(path: str | Path, device: str = "auto") -> TrainedScene:
    """The trained scene of a run of `unmix-nerf`.

    Args:
        path: Run folder.
        device: `auto`, `cpu` or `cuda`.
    Raises:
        RunError: the run is missing, half-written, damaged, or from a newer version.
        ConfigError: the device is not there, or the method does not unmix spectra.
    """
    return load_run(path, device).materials_scene


def open_measured(path: str | Path, data: str | Path | None = None) -> MeasuredScene:
    """What a run was trained on, for `spectrum_at`.

    Args:
        path: Run folder.
        data: Scene folder, where it is no longer where the run was trained on it.
    Raises:
        RunError: the run is damaged, or the scene is another than the run's.
        SceneError: the scene is missing, has changed, or is malformed.
    """
    run = open_run_folder(Path(path))
    record = read_scene_record(run, read_config(run).pipeline.datamanager.target)
    scene = find_scene(record.summary, run.path, None if data is None else Path(data))
    if scene is None:
        place = record.summary.get("root")
        raise SceneError(f"no scene, or no longer the same, at {place}; give its folder as data")
    return MeasuredScene(scene, record.summary.get("illuminant"))


def mixture_scene(
    model: Model, method_name: str, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> TrainedScene | None:
    """The scene of mixed materials that a method makes; None of a method that makes none."""
    if find_method(method_name).scene is None:  # shown by its own outputs, if it names some
        return None
    scene = snapshot(model, method_name, record, averages)
    return scene if isinstance(scene, TrainedScene) else None


def require_materials(scene: RenderableScene | None, method_name: str) -> TrainedScene:
    """The scene, if it has endmembers, otherwise a ConfigError; None stands for a method that makes none."""
    if not isinstance(scene, TrainedScene):
        own: list[str] = []
        with suppress(Exception):  # a third party's module may fail in any way at all
            make = discover_methods()[0][method_name].products
            own = [product.name for product in make()] if make is not None else []
        raise ConfigError(
            f"the method {method_name} makes no scene of mixed materials, as unmix-nerf does and this needs"
            + (f"; unmix-export has products of its own for it: {', '.join(own)}" if own else "")
        )
    return scene
