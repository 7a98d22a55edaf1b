"""Training of the small prior: true materials at surface points against what it says of them.

Notation: `B` objects, `N` points, `P` parameters of a material.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.prior.beta_nll import beta_nll
from unmix_plugin.neumatex.prior.small_network import Observations, SmallPrior, TaskName
from unmix_plugin.neumatex.prior.training_data import TrainingObjects

Truth = dict[TaskName, Tensor]
"""What is to be learnt of each task, B x N x P."""
_PBR_COLUMNS = [0, 1, 2, 4, 3]
"""Base colour, roughness and metallicity among the parameters of `LayeredFamily`."""

_DESCRIBED = {6: [7], 8: [9, 10], 11: [12]}
"""Weights of coat, sheen and haze, and the parameters that describe these layers."""


@dataclass(frozen=True)
class PriorTraining:
    """Settings of one training."""

    seconds: float = 1500.0
    """How long to train; the learning rate follows the clock, so that it ends at 0 on any machine."""
    batch: int = 12
    """Objects a step."""
    points: int = 128
    """Points of an object."""
    views: int = 8
    """Views of an object that the prior sees at most."""
    learning_rate: float = 1.5e-3
    nll_weight: float = 1.0
    nll_from: float = 0.15
    """Part of the training after which the likelihood counts, first a little."""
    nll_full_from: float = 0.2
    """Part of the training after which it counts fully."""
    seed: int = 0


def true_pbr(materials: Float[Tensor, "*n L"]) -> Float[Tensor, "*n 5"]:
    """Base colour, roughness and metallicity of layered materials, as if there were no other layers."""
    return materials[..., _PBR_COLUMNS]


def true_layers(materials: Float[Tensor, "*n L"]) -> Float[Tensor, "*n L"]:
    """Parameters of `LayeredFamily`, those of a layer times its weight: where it is absent they mean nothing."""
    layers = materials.clone()
    for weight, described in _DESCRIBED.items():
        layers[..., described] *= materials[..., weight : weight + 1]
    return layers


def train(
    prior: SmallPrior,
    objects: TrainingObjects,
    truth: Truth,
    settings: PriorTraining,
    report: Callable[[int, float, float], None],
) -> int:
    """Train a prior in place, and say how many steps it took.

    Args:
        truth: What is to be learnt of each task, at all points.
        report: Called now and then with the step, the part that is done, and the running loss.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    moved = [p for name, p in prior.named_parameters() if "readers" not in name]
    optimiser = torch.optim.AdamW(moved, lr=settings.learning_rate, weight_decay=1e-3)
    started, step, running, done = time.monotonic(), 0, math.nan, 0.0
    while done < 1:
        for group in optimiser.param_groups:
            group["lr"] = (
                settings.learning_rate * min(1.0, (step + 1) / 50) * (1 + math.cos(math.pi * done)) / 2
            )
        loss = training_loss(
            prior, *draw_batch(objects, truth, settings, generator), nll_weight(settings, done)
        )
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(moved, 1.0)
        optimiser.step()
        running = loss.item() if math.isnan(running) else 0.98 * running + 0.02 * loss.item()
        step += 1
        done = (time.monotonic() - started) / settings.seconds
        if step % 50 == 0:
            report(step, done, running)
    return step


def nll_weight(settings: PriorTraining, done: float) -> float:
    """What the likelihood counts beside the squared error, when this part of the training is done."""
    ramp = (done - settings.nll_from) / (settings.nll_full_from - settings.nll_from)
    return settings.nll_weight * min(1.0, max(0.0, ramp))


def training_loss(
    prior: SmallPrior, observations: Observations, truth: Truth, weight: float
) -> Float[Tensor, ""]:
    """Squared error of the material, and `weight` times the likelihood."""
    embeddings = prior(observations)
    total = embeddings.new_zeros(())
    for task, target in truth.items():
        predicted, log_variance = prior.estimate(embeddings, task)
        total = total + (predicted - target).square().mean()
        if weight > 0:
            total = total + weight * beta_nll(predicted, log_variance, target)
    return total


def draw_batch(
    objects: TrainingObjects, truth: Truth, settings: PriorTraining, generator: torch.Generator
) -> tuple[Observations, Truth]:
    """Some objects, each turned and mirrored, with some of its points and views."""
    rows = torch.randint(len(objects), (settings.batch,), generator=generator).tolist()
    batch = objects.select(rows).observations
    positions = _turned(batch.positions, generator)
    num_points, num_views = batch.visible.shape[1:]
    points = torch.randperm(num_points, generator=generator)[: settings.points]
    views = torch.randperm(num_views, generator=generator)[: settings.views]
    seen = replace(batch, positions=positions).selected(points, views)
    hidden = torch.rand(settings.batch, 1, len(views), generator=generator)
    hidden = hidden < 0.6 * torch.rand(settings.batch, 1, 1, generator=generator)
    seen = replace(seen, visible=seen.visible & ~hidden)
    return seen, {task: values[rows][:, points] for task, values in truth.items()}


def _turned(positions: Float[Tensor, "B N 3"], generator: torch.Generator) -> Float[Tensor, "B N 3"]:
    """Each object with its axes permuted and mirrored: nothing else that is observed changes."""
    count = len(positions)
    order = torch.rand(count, 3, generator=generator).argsort(dim=1)
    signs = 1.0 - 2.0 * torch.randint(2, (count, 1, 3), generator=generator)
    return positions.gather(2, order[:, None].expand_as(positions)) * signs
