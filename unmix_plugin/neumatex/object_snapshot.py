"""From a model of neumatex, trained or in training, to the object that it holds at this moment."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.neumatex.trained_object import TrainedObject
from unmix_plugin.trained.model_scene import frozen_parameters
from unmix_plugin.trained.run_views import recorded_views
from unmix_plugin.trained.world_frame import world_frame

if TYPE_CHECKING:
    from unmix_plugin.neumatex.model import NeumatexModel


def trained_object(
    model: NeumatexModel, record: SceneRecord, averages: Mapping[str, Tensor] | None = None
) -> TrainedObject:
    """The object of a model as it is now; training that goes on does not change it.

    Args:
        model, averages: As `frozen_parameters` takes them.
        record: Cameras and frame of its run.
    Raises:
        RunError: the record is damaged.
    """
    frozen = frozen_parameters(model, averages)
    triplane = copy.deepcopy(model.triplane, dict(frozen)).eval()  # type: ignore[arg-type]
    curve = copy.deepcopy(model.curve, dict(frozen)).eval()  # type: ignore[arg-type]
    family = copy.deepcopy(model.family, dict(frozen))  # type: ignore[arg-type]
    return TrainedObject(
        model.traced.ray_mesh,
        replace(model.surface, family=family, triplane=triplane),
        model.environment,
        world_frame(record),
        recorded_views(record),
        record.scene_box,
        curve,
        None if model.record.is_spectral else triplane.log_variance,
        model.config.render_samples,
        model.config.bounces,
        bands=model.record.bands,
        lamp=torch.tensor(model.record.lamp) if model.record.is_spectral else None,
    )
