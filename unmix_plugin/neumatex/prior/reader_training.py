"""Training of the networks that read planes: they learn to be fitted fast, to the truth and to what the prior says.

Groups of objects get planes of 0; planes and readers are then moved together for some steps, and the next group comes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from unmix_plugin.neumatex.prior.plane_fit import RESOLUTION, Estimates, fit_loss
from unmix_plugin.neumatex.prior.small_network import MaterialName, SmallPrior
from unmix_plugin.neumatex.prior.training import Truth
from unmix_plugin.neumatex.prior.training_data import TrainingObjects
from unmix_plugin.neumatex.triplane import NUM_CHANNELS


@dataclass(frozen=True)
class ReaderTraining:
    """Settings of one training."""

    seconds: float = 300.0
    """How long to train each material's readers."""
    group: int = 8
    """Objects fitted at the same time."""
    steps: int = 60
    """Steps of a group."""
    learning_rate: float = 2e-3
    """Of the readers at the start; it falls to 0."""
    plane_rate: float = 0.05
    seed: int = 0


def train_readers(
    prior: SmallPrior,
    objects: TrainingObjects,
    truth: Truth,
    material: MaterialName,
    settings: ReaderTraining,
    report: Callable[[int, float, float], None],
) -> int:
    """Train one material's readers in place, and say how many groups they saw.

    Args:
        report: Called after each group with its number, the part that is done, and its last loss.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    readers = prior.readers_of(material)
    optimiser = torch.optim.Adam(readers.parameters(), lr=settings.learning_rate)
    started, group, done = time.monotonic(), 0, 0.0
    while done < 1:
        rows = torch.randint(len(objects), (settings.group,), generator=generator).tolist()
        estimates = what_is_said(prior, objects.select(rows), truth[material][rows], material, group % 2 == 0)
        planes = torch.zeros(settings.group, 3, NUM_CHANNELS, RESOLUTION, RESOLUTION, requires_grad=True)
        plane_optimiser = torch.optim.Adam([planes], lr=settings.plane_rate)
        loss = planes.new_zeros(())
        for parameters in optimiser.param_groups:
            parameters["lr"] = settings.learning_rate * (1 - done)
        for _ in range(settings.steps):
            loss = fit_loss(readers, planes, estimates)
            optimiser.zero_grad()
            plane_optimiser.zero_grad()
            # A texel's gradient is that of its own object, however many are fitted at a time.
            loss.backward()
            optimiser.step()
            plane_optimiser.step()
        group += 1
        done = (time.monotonic() - started) / settings.seconds
        report(group, done, loss.item())
    return group


@torch.no_grad()
def what_is_said(
    prior: SmallPrior,
    objects: TrainingObjects,
    truth: torch.Tensor,
    material: MaterialName,
    use_truth: bool,
) -> Estimates:
    """What the prior says of points, or the truth with the prior's log-variances."""
    parameters, log_variance = prior.estimate(prior(objects.observations), material)
    return Estimates(objects.observations.positions, truth if use_truth else parameters, log_variance)
