"""What the package registers for objects: the method `neumatex`, with all its settings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unmix_plugin.engine import MethodSpecification, OptimizerConfig, PipelineConfig, TrainerConfig


def _scene(*arguments: Any) -> Any:
    """See `trained_object`; imported when a run is opened."""
    from unmix_plugin.neumatex.fit.trained_object import trained_object

    return trained_object(*arguments)


def _products() -> Sequence[Any]:
    """What `unmix-export` makes of objects; imported when the command is called."""
    from unmix_plugin.neumatex.export.product import MaterialProduct

    return (MaterialProduct(),)


def _complete(config: TrainerConfig) -> TrainerConfig:
    """See `with_object_made`; imported when a training starts."""
    from unmix_plugin.neumatex.from_run.object_folder import with_object_made

    return with_object_made(config)


def _neumatex() -> TrainerConfig:
    """The settings; imported when the method is used."""
    from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
    from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig

    return TrainerConfig(
        method_name="neumatex",
        output_dir=Path("outputs"),
        max_num_iterations=300,
        steps_per_save=100,
        steps_per_log=5,
        pipeline=PipelineConfig(datamanager=ObjectDataManagerConfig(), model=NeumatexModelConfig()),
        optimizers={
            "planes": OptimizerConfig(lr=5e-3, final_factor=0.2),
            "networks": OptimizerConfig(lr=5e-3, final_factor=0.2),
            "response": OptimizerConfig(lr=2e-2, final_factor=0.1),
            # Brightness soon comes right; shapes of spectra drift where they may move as fast (see fit.model).
            "endmembers": OptimizerConfig(lr=1e-3, final_factor=0.1),
            "gains": OptimizerConfig(lr=6e-3, final_factor=0.1),
            "gloss": OptimizerConfig(lr=5e-2, final_factor=0.1),
            "light": OptimizerConfig(lr=2e-2, final_factor=0.1),
            "normals": OptimizerConfig(lr=1e-2, final_factor=0.1),
        },
    )


neumatex = MethodSpecification(
    _neumatex,
    name="neumatex",
    description="relightable materials of an object, on a given mesh and in a given light or on those of a run",
    scene=_scene,
    products=_products,
    complete=_complete,
)
