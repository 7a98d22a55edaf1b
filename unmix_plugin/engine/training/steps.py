"""Training steps: a batch, its gradients, the update. They are the same in each of the processes that train together;
the first of these has a `Trainer`, the others follow it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from unmix_plugin.engine.configs import OptimizerConfig, TrainerConfig
from unmix_plugin.engine.machine import resolve_device, seed_everything
from unmix_plugin.engine.model import TrainingCallback, TrainingCallbackLocation
from unmix_plugin.engine.pipeline import Pipeline
from unmix_plugin.engine.processes import ALONE, Follower, Processes, joined, require_equal_settings
from unmix_plugin.engine.registry import discover_methods
from unmix_plugin.engine.runs.checkpoints import (
    Checkpoint,
    TrainingRecord,
    newest_complete_checkpoint,
    restore_training,
)
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.engine.runs.loading import require_data
from unmix_plugin.engine.runs.run_folder import open_run_folder
from unmix_plugin.engine.training.batches import mean_values, work_on_batches
from unmix_plugin.engine.training.optimizers import (
    GradientGuard,
    build_optimizer,
    forget_gradients,
    set_learning_rates,
)
from unmix_plugin.engine.training.training_control import stop_signals
from unmix_plugin.errors import ConfigError, RunError, UnmixError, name_some


@dataclass(frozen=True)
class StepResult:
    """What a training step gave."""

    loss: float
    """Mean over the processes."""
    values: dict[str, Tensor]
    """Losses and metrics of this process's rays without their graphs, and how many rays and samples there were."""
    num_rays: int
    """Of all processes."""
    is_refused: bool
    """Whether loss or gradients were not finite, so that nothing was updated."""
    has_reset: bool
    """Whether parameters were reset before it."""


class TrainingSteps:
    """Takes the training steps of one pipeline."""

    def __init__(
        self, pipeline: Pipeline, configs: Mapping[str, OptimizerConfig], processes: Processes
    ) -> None:
        """
        Args:
            pipeline: Its model has its first values.
            configs: Settings of the optimiser by parameter group.
            processes: That take these steps together.
        Raises:
            ConfigError: a group of the model has no optimizer config or a parameter that no checkpoint would hold, or
                there are more processes than rays.
        """
        self.pipeline, self.configs, self.processes = pipeline, configs, processes
        pipeline.model.processes = processes
        groups, known = pipeline.model.get_param_groups(), set(map(id, pipeline.model.parameters()))
        if stray := [name for name, own in groups.items() if not known.issuperset(map(id, own))]:
            raise ConfigError(
                f"the parameter group {', '.join(stray)} has parameters that no module of the model holds, nor would a "
                "checkpoint: make them attributes, or entries of an nn.ParameterList"
            )
        trained = {id(param) for own in groups.values() for param in own}
        untrained = {
            name
            for name, param in pipeline.model.named_parameters()
            if param.requires_grad and param.numel() and id(param) not in trained
        }
        if untrained:
            pipeline.warn(
                f"{name_some(sorted(untrained))} of the model can be trained, but no parameter group has it"
            )
        self.optimizer = build_optimizer(groups, configs)
        self.guard = GradientGuard(self.optimizer)
        self.callbacks = [
            *pipeline.datamanager.get_training_callbacks(),
            *pipeline.model.get_training_callbacks(),
        ]
        self.learning_rates: dict[str, float] = {}
        if processes.count > 1:
            self.share_rays(pipeline.datamanager.get_train_rays_per_batch())

    @property
    def num_rays(self) -> int:
        """Rays of the next step in all processes."""
        return self.pipeline.datamanager.get_train_rays_per_batch() * self.processes.count

    def share_rays(self, num_rays: int) -> None:
        """Let the next steps have so many rays in all processes. Raises ConfigError: more processes than rays."""
        own = num_rays // self.processes.count
        if own == 0:
            raise ConfigError(
                f"{self.processes.count} processes for {num_rays} rays per step; use fewer processes"
            )
        self.pipeline.datamanager.set_train_rays_per_batch(own)

    def restore(self, checkpoint: Checkpoint) -> TrainingRecord:
        """Go on from a checkpoint, whatever number of processes wrote it; how far it had come.

        Raises:
            RunError: it does not fit the model, or is damaged.
            ConfigError: more processes than rays.
        """
        restore_training(checkpoint.tensors, self.pipeline.model, self.optimizer)
        record = TrainingRecord.from_json(checkpoint.record)
        self.share_rays(record.num_rays)
        self.learning_rates = record.learning_rates
        self.guard.skipped = record.skipped_steps
        return record

    def begin(self, step: int) -> None:
        """Start all processes from the first one's model, before step number `step`. Raises RunError: a process is at
        another step: their checkpoints differ."""
        self.processes.equalise(self.pipeline.model.state_dict().values())
        found = set(self.processes.gather(step))
        if len(found) > 1:
            raise RunError(
                f"the processes go on from checkpoints of different steps, {sorted(found)}: a run folder is "
                "not the same for all of them"
            )
        self.pipeline.draw_as(self.processes.rank)

    def take(self, step: int, progress: float) -> StepResult:
        """Take step number `step` at `progress` in [0, 1]. Raises RunError: loss and gradients stay non-finite, or
        another process has ended."""
        pipeline, datamanager = self.pipeline, self.pipeline.datamanager
        if not pipeline.model.training:  # a viewer may have left it in evaluation mode
            pipeline.train()
        pipeline.seed_step(step)
        run_callbacks(self.callbacks, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step, progress)
        with torch.no_grad():
            reset = pipeline.model.between_steps(step, progress, datamanager)
        if reset:
            forget_gradients(self.optimizer, reset)
        num_rays = datamanager.get_train_rays_per_batch()
        self.learning_rates = set_learning_rates(self.optimizer, self.configs, progress)
        self.optimizer.zero_grad()
        batches = work_on_batches(pipeline, step)
        total = torch.stack([batch.loss for batch in batches]).sum()
        with torch.no_grad():
            for batch in batches:
                pipeline.model.update(batch.outputs)
        num_samples = sum(pipeline.model.num_samples(batch.outputs) for batch in batches)
        wanted = pipeline.model.next_num_rays(num_samples, num_rays)
        if self.processes.count > 1:
            total, wanted = self._averaged(total, wanted)
        is_finite, loss = self.guard.check(total)
        if is_finite:
            self.optimizer.step()
        run_callbacks(self.callbacks, TrainingCallbackLocation.AFTER_TRAIN_ITERATION, step, progress)
        if wanted is not None:
            datamanager.set_train_rays_per_batch(wanted)
        values = mean_values(batches)
        for name, count in {"num_rays": num_rays, "num_samples": num_samples}.items():
            values[name] = torch.tensor(float(count))
        return StepResult(loss, values, num_rays * self.processes.count, not is_finite, bool(reset))

    def _averaged(self, total: Tensor, wanted: int | None) -> tuple[Tensor, int | None]:
        """Gradients, loss and the rays wanted for the next step, as means over the processes."""
        parameters = [param for group in self.optimizer.param_groups for param in group["params"]]
        rays = total.new_tensor(float("nan") if wanted is None else float(wanted))
        total, rays = self.processes.average_gradients(parameters, [total, rays])
        return total, None if wanted is None else max(1, int(rays))


def run_callbacks(
    callbacks: Iterable[TrainingCallback], where: TrainingCallbackLocation, step: int, progress: float
) -> None:
    """Call those of `callbacks` that belong at `where`, in their order."""
    for callback in callbacks:
        if callback.where is where:
            callback.func(step, progress)


def prepare_steps(config: TrainerConfig, processes: Processes = ALONE) -> tuple[TrainerConfig, TrainingSteps]:
    """Read the scene and make the model; settings without `auto`, and what takes the steps. Raises SceneError,
    ConfigError: scene or settings are wrong."""
    device = resolve_device(config.device)
    method = discover_methods()[0].get(config.method_name)
    if config.load_run is None and method is not None and method.complete is not None:
        config = method.complete(config)
    seed_everything(config.seed)
    pipeline: Pipeline = config.pipeline.setup(data=require_data(config), device=device, seed=config.seed)
    if config.load_run is None:
        pipeline.initialise()
    steps = TrainingSteps(pipeline, config.optimizers, processes)
    return replace(config, pipeline=pipeline.config), steps


@contextmanager
def joined_training(config: TrainerConfig) -> Iterator[Processes]:
    """Context in which this process trains with the others that were started with it.

    Raises:
        ConfigError: their settings differ, or this machine can't run them.
        Follower: the same, in a process that isn't the first.
    """
    with joined(config.device) as processes:
        everywhere = replace(config, output_dir=Path(), data=None, load_run=None)
        require_equal_settings(processes, config_to_json(everywhere))
        yield processes


_STOPPED = 130
"""Exit code of a process that was asked to stop, as after Ctrl-C."""


def follow_training(config: TrainerConfig, processes: Processes) -> TrainingSteps:
    """Train along with the first process until it says that training is over.

    Returns:
        What took the steps, with the model as it is then.
    Raises:
        Follower: the training fails, or is stopped on request, which the first process says.
    """
    try:
        with processes.together():
            _, steps = prepare_steps(config, processes)
        step = 0
        with processes.together():
            if config.load_run is not None:
                checkpoints = open_run_folder(config.load_run).checkpoints
                step = steps.restore(newest_complete_checkpoint(checkpoints)).steps
        steps.pipeline.model.warm_up()
        # A terminal's Ctrl-C reaches all processes; the first decides when to stop, and saves.
        with stop_signals([]):
            steps.begin(step)
            while (progress := processes.announce(None)) is not None:
                steps.take(step, progress)
                step += 1
            if processes.announce(None) is None:
                raise Follower(_STOPPED)
    except UnmixError as error:
        raise Follower(2) from error
    return steps
