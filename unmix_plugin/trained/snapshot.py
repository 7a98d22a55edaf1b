"""From a model, trained or in training, to the scene that it holds at this moment."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from unmix_plugin.engine.model import Model
from unmix_plugin.engine.registry import find_method
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.model import UnmixModel
from unmix_plugin.trained.model_scene import frozen_parameters, model_scene
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.run_views import recorded_views
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.trained.world_frame import world_frame


def unmix_scene(
    model: UnmixModel, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> TrainedScene:
    """The scene of a model as it is now; training that goes on does not change it.

    Args:
        model, averages: As `frozen_parameters` takes them.
        record: Cameras and frame of its run; they are shown as they were corrected, those of evaluation views with the
            corrected lens.
    Raises:
        RunError: the record is damaged.
    """
    frozen = frozen_parameters(model, averages)
    materials, renderer = model.materials, model.renderer
    specular = frozen.get(id(materials.specular_spectra), materials.specular_spectra)
    if model.poses is not None:
        own = copy.deepcopy(model.poses, frozen)  # type: ignore[arg-type]
        record = replace(
            record,
            train_cameras=own.refined(record.train_cameras),
            eval_cameras=own.lens.of(record.eval_cameras),
        )
    materials = replace(materials, endmembers=frozen[id(model.endmembers)], specular_spectra=specular)
    opaque = renderer.opaque_skips
    renderer = replace(
        renderer,
        skips=renderer.skips.clone(),
        reachable=renderer.reachable.clone(),
        opaque_skips=None if opaque is None else opaque.clone(),
    )
    return TrainedScene(
        copy.deepcopy(model.field, frozen).eval(),  # type: ignore[arg-type]
        renderer,
        materials.to(model.device),
        world_frame(record),
        recorded_views(record),
        model.metadata["pixel_size"],
        model.metadata["subpixels"],
        fitted=(
            *(["pose"] if model.poses is not None else []),
            *(["gain"] if model.view_gains is not None else []),
        ),
    )


def snapshot(
    model: Model, method_name: str, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> RenderableScene:
    """The scene of a model of any method, as its registration makes it.

    Raises:
        RunError: the record is damaged.
        ConfigError: the method offers no scene.
    """
    make = find_method(method_name).scene or model_scene
    return make(model, record, averages)
