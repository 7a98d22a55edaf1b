"""The batches of a training step, and their gradients: usually one batch; on a CPU with several threads two.

Two batches, each of half of the rays, are worked on at once by half of the threads each. Both add their gradients to
those of the parameters, in either order the same sum; of more than two it would not be, and a training could not be
repeated.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from unmix_plugin.engine.configs import place_of
from unmix_plugin.engine.machine import can_work_beside, working_beside
from unmix_plugin.engine.model import Model, TrainOutputs
from unmix_plugin.engine.pipeline import Pipeline
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class BatchResult:
    """What a batch gave, whose gradients were added to those of the parameters."""

    outputs: dict[str, Any]
    values: dict[str, Tensor]
    """Losses and metrics without their graphs."""
    loss: Tensor
    """What of the step's loss is this batch's, without its graph."""


def work_on_batches(pipeline: Pipeline, step: int) -> list[BatchResult]:
    """Work out the batches of training step `step`, and add their gradients to those of the parameters.

    Raises:
        ConfigError: the model's losses can't be added up.
    """
    model, rays = pipeline.model, pipeline.datamanager.get_train_rays_per_batch()
    if min(model.batches_at_once, rays) == 1 or not can_work_beside(model.device):
        (batch,) = pipeline.train_batches(step)
        return [_gradients(batch, model, 1.0)]
    batches = pipeline.train_batches(step, 2)
    with working_beside(partial(_gradients, next(batches), model, 0.5)) as other:  # while the next is drawn
        own = _gradients(next(batches), model, 0.5)
    return [other.result(), own]


def _gradients(batch: Callable[[], TrainOutputs], model: Model, share: float) -> BatchResult:
    outputs, losses, metrics = batch()
    require_losses(losses, type(model))
    loss = share * torch.stack([loss.reshape(()) for loss in losses.values()]).sum()
    loss.backward()
    values = {name: value.detach() for name, value in {**losses, **metrics}.items()}
    return BatchResult(outputs, values, loss.detach())


def mean_values(batches: Sequence[BatchResult]) -> dict[str, Tensor]:
    """Losses and metrics by name, each the mean over the batches that have it."""
    found: dict[str, list[Tensor]] = defaultdict(list)
    for batch in batches:
        for name, value in batch.values.items():
            found[name].append(value)
    return {name: torch.stack(own).mean(dim=0) for name, own in found.items()}


def require_losses(losses: Mapping[str, Any], kind: type) -> None:
    """Refuse losses of a model of this class that can't be added up. Raises ConfigError: naming the class and where it
    is written."""
    if not losses:
        raise ConfigError(
            f"get_loss_dict of {place_of(kind)} gives no loss: training has nothing to make smaller"
        )
    for name, loss in losses.items():
        found = f"a {type(loss).__name__}"
        if isinstance(loss, Tensor):
            found = f"a tensor of the shape {tuple(loss.shape)}"
        if not isinstance(loss, Tensor) or loss.numel() != 1:
            raise ConfigError(
                f"the loss {name} of {place_of(kind)} is {found}; expected a tensor of one number, as mean() gives"
            )
    if not any(loss.requires_grad for loss in losses.values()):
        raise ConfigError(
            f"no loss of {place_of(kind)} depends on a parameter: is something detached, or made under no_grad?"
        )
