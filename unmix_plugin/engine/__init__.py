"""The generic engine: what a method is made of, training it, and bringing its runs back. It knows no spectrum.

A method is a `MethodSpecification` around a `TrainerConfig` that names subclasses of `DataManager` and `Model`;
`Trainer` trains it, `load_model` brings it back. Methods import from here alone; the modules below may change.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from unmix_plugin.engine.configs import (
        AtStart,
        Common,
        DataManagerConfig,
        InstantiateConfig,
        ModelConfig,
        OptimizerConfig,
        PipelineConfig,
        Target,
        TrainerConfig,
        short,
    )
    from unmix_plugin.engine.geometry.camera_paths import nearest_to_axes, upright_cameras
    from unmix_plugin.engine.geometry.cameras import Cameras
    from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
    from unmix_plugin.engine.machine import step_generator
    from unmix_plugin.engine.model import (
        DataManager,
        Field,
        Model,
        TrainingCallback,
        TrainingCallbackLocation,
    )
    from unmix_plugin.engine.pipeline import Pipeline
    from unmix_plugin.engine.registry import (
        MethodSpecification,
        Output,
        discover_methods,
        find_method,
        named_output,
    )
    from unmix_plugin.engine.runs.config_json import config_from_json
    from unmix_plugin.engine.runs.load_run import LoadedModel, load_config, load_model, load_pipeline
    from unmix_plugin.engine.runs.scene_record import SceneRecord
    from unmix_plugin.engine.training.trainer import Trainer

_MODULES = {
    "configs": (
        "AtStart",
        "Common",
        "DataManagerConfig",
        "InstantiateConfig",
        "ModelConfig",
        "OptimizerConfig",
        "PipelineConfig",
        "Target",
        "TrainerConfig",
        "short",
    ),
    "geometry.camera_paths": ("nearest_to_axes", "upright_cameras"),
    "geometry.cameras": ("Cameras",),
    "geometry.space": ("RayBundle", "SceneBox"),
    "machine": ("step_generator",),
    "model": ("DataManager", "Field", "Model", "TrainingCallback", "TrainingCallbackLocation"),
    "pipeline": ("Pipeline",),
    "registry": ("MethodSpecification", "Output", "discover_methods", "find_method", "named_output"),
    "runs.config_json": ("config_from_json",),
    "runs.load_run": ("LoadedModel", "load_config", "load_model", "load_pipeline"),
    "runs.scene_record": ("SceneRecord",),
    "training.trainer": ("Trainer",),
}

__all__ = [
    "AtStart",
    "Cameras",
    "Common",
    "DataManager",
    "DataManagerConfig",
    "Field",
    "InstantiateConfig",
    "LoadedModel",
    "MethodSpecification",
    "Model",
    "ModelConfig",
    "OptimizerConfig",
    "Output",
    "Pipeline",
    "PipelineConfig",
    "RayBundle",
    "SceneBox",
    "SceneRecord",
    "Target",
    "Trainer",
    "TrainerConfig",
    "TrainingCallback",
    "TrainingCallbackLocation",
    "config_from_json",
    "discover_methods",
    "find_method",
    "load_config",
    "load_model",
    "load_pipeline",
    "named_output",
    "nearest_to_axes",
    "short",
    "step_generator",
    "upright_cameras",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: a command that needs one should not pay for all."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
