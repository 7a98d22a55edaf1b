"""Settings of a training that has a run in place of data."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from unmix_plugin.engine import TrainerConfig
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig
from unmix_plugin.neumatex.from_run.object_folder import ObjectRecipe, object_of_run


def completed(config: TrainerConfig) -> TrainerConfig:
    """Settings with the object's folder as data, which is made of --from-run where no data is given; files that they
    name are found from any working directory then. Errors are those of `object_of_run`."""
    model, data = config.pipeline.model, config.pipeline.datamanager
    if not isinstance(model, NeumatexModelConfig) or not isinstance(data, ObjectDataManagerConfig):
        return config  # of a method that took ours for its own
    run, mesh, environment = map(_resolved, (model.from_run, data.mesh, data.environment))
    pipeline = replace(
        config.pipeline,
        model=replace(model, from_run=run),
        datamanager=replace(data, mesh=mesh, environment=environment),
    )
    config = replace(config, pipeline=pipeline)
    if config.data is not None or run is None:
        return config
    recipe = ObjectRecipe(run, data.mesh_triangles, mesh, environment, data.lamp)
    return replace(config, data=object_of_run(recipe, lambda line: sys.stderr.write(f"{line}\n")))


def _resolved(path: Path | None) -> Path | None:
    return None if path is None else path.resolve()
