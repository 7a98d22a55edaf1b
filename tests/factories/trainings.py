"""Trainings without a display, to their end or stopped after a step."""

import io
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.model import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.runs.checkpoints import Checkpoint, newest_complete_checkpoint
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import Interrupted


def quiet_trainer(config: TrainerConfig) -> Trainer:
    return Trainer(config, console=Console(file=io.StringIO()))


def finished(config: TrainerConfig) -> Trainer:
    trainer = quiet_trainer(config)
    trainer.train()
    return trainer


def call_after_step(trainer: Trainer, step: int, action: Callable[[], Any]) -> None:
    """Let `action` run inside the step that brings the count to `step`."""
    where = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
    trainer.callbacks.append(TrainingCallback(where, lambda i, _: action() if i + 1 == step else None))


def stop_at(config: TrainerConfig, step: int, number: int = signal.SIGINT) -> Interrupted:
    trainer = quiet_trainer(config)
    call_after_step(trainer, step, lambda: signal.raise_signal(number))
    with pytest.raises(Interrupted) as caught:
        trainer.train()
    return caught.value


def newest(run: Path) -> Checkpoint:
    return newest_complete_checkpoint(run / "checkpoints")
