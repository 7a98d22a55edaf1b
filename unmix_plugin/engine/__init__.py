"""The generic engine: what a method is made of, training it, and bringing its runs back. It knows no spectrum.

A method is a `MethodSpecification` around a `TrainerConfig` that names subclasses of `DataManager` and `Model`;
`Trainer` trains it, `load_model` brings it back. Methods import from here alone; the modules below may change.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unmix_plugin.engine.configs import AtStartOnly as AtStartOnly
    from unmix_plugin.engine.configs import Check as Check
    from unmix_plugin.engine.configs import CommonFlag as CommonFlag
    from unmix_plugin.engine.configs import DataManagerConfig as DataManagerConfig
    from unmix_plugin.engine.configs import InstantiateConfig as InstantiateConfig
    from unmix_plugin.engine.configs import ModelConfig as ModelConfig
    from unmix_plugin.engine.configs import OptimizerConfig as OptimizerConfig
    from unmix_plugin.engine.configs import PipelineConfig as PipelineConfig
    from unmix_plugin.engine.configs import Target as Target
    from unmix_plugin.engine.configs import TrainerConfig as TrainerConfig
    from unmix_plugin.engine.configs import Within as Within
    from unmix_plugin.engine.configs import short_flag as short_flag
    from unmix_plugin.engine.decisions import UNDECIDED as UNDECIDED
    from unmix_plugin.engine.decisions import Decision as Decision
    from unmix_plugin.engine.geometry.camera_paths import nearest_to_axes as nearest_to_axes
    from unmix_plugin.engine.geometry.camera_paths import upright_cameras as upright_cameras
    from unmix_plugin.engine.geometry.cameras import Cameras as Cameras
    from unmix_plugin.engine.geometry.space import RayBundle as RayBundle
    from unmix_plugin.engine.geometry.space import SceneBox as SceneBox
    from unmix_plugin.engine.machine import step_generator as step_generator
    from unmix_plugin.engine.model import DataManager as DataManager
    from unmix_plugin.engine.model import Field as Field
    from unmix_plugin.engine.model import Model as Model
    from unmix_plugin.engine.model import TrainingCallback as TrainingCallback
    from unmix_plugin.engine.model import TrainingCallbackLocation as TrainingCallbackLocation
    from unmix_plugin.engine.outputs import Output as Output
    from unmix_plugin.engine.outputs import named_output as named_output
    from unmix_plugin.engine.pipeline import Pipeline as Pipeline
    from unmix_plugin.engine.registry import MethodSpecification as MethodSpecification
    from unmix_plugin.engine.registry import discover_methods as discover_methods
    from unmix_plugin.engine.registry import find_method as find_method
    from unmix_plugin.engine.runs.config_json import config_from_json as config_from_json
    from unmix_plugin.engine.runs.loading import LoadedModel as LoadedModel
    from unmix_plugin.engine.runs.loading import load_config as load_config
    from unmix_plugin.engine.runs.loading import load_model as load_model
    from unmix_plugin.engine.runs.loading import load_pipeline as load_pipeline
    from unmix_plugin.engine.runs.scene_record import SceneRecord as SceneRecord
    from unmix_plugin.engine.training.trainer import Trainer as Trainer

_MODULES = {
    "configs": (
        "AtStartOnly",
        "Check",
        "CommonFlag",
        "DataManagerConfig",
        "InstantiateConfig",
        "ModelConfig",
        "OptimizerConfig",
        "PipelineConfig",
        "Target",
        "TrainerConfig",
        "Within",
        "short_flag",
    ),
    "decisions": ("UNDECIDED", "Decision"),
    "geometry.camera_paths": ("nearest_to_axes", "upright_cameras"),
    "geometry.cameras": ("Cameras",),
    "geometry.space": ("RayBundle", "SceneBox"),
    "machine": ("step_generator",),
    "model": ("DataManager", "Field", "Model", "TrainingCallback", "TrainingCallbackLocation"),
    "pipeline": ("Pipeline",),
    "outputs": ("Output", "named_output"),
    "registry": ("MethodSpecification", "discover_methods", "find_method"),
    "runs.config_json": ("config_from_json",),
    "runs.loading": ("LoadedModel", "load_config", "load_model", "load_pipeline"),
    "runs.scene_record": ("SceneRecord",),
    "training.trainer": ("Trainer",),
}
__all__ = sorted(name for names in _MODULES.values() for name in names)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: a command that needs one should not pay for all."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
