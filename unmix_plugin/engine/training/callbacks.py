"""What a model or a data manager wants done around each training step."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum


class TrainingCallbackLocation(Enum):
    """When a callback runs."""

    BEFORE_TRAIN_ITERATION = "before"
    """Before the rays of the step are drawn."""
    AFTER_TRAIN_ITERATION = "after"
    """After the optimiser's update, also when a step was skipped for a non-finite loss or gradient."""


@dataclass(frozen=True)
class TrainingCallback:
    """One function and the place in the step at which the trainer calls it."""

    where: TrainingCallbackLocation
    """Before or after the update."""
    func: Callable[[int, float], None]
    """Called with the step (0 for the first) and the training progress in [0, 1]: the fraction used up of whichever
    limit, steps or seconds, is nearer its end."""


def run_callbacks(
    callbacks: list[TrainingCallback], where: TrainingCallbackLocation, step: int, progress: float
) -> None:
    """Call those of `callbacks` that belong at `where`, in their order."""
    for callback in callbacks:
        if callback.where is where:
            callback.func(step, progress)
