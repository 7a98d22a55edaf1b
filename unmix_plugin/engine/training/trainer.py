"""The training loop: steps (one batch, its gradients, the update), and what is saved, shown and measured between them.

Steps are the same in each of the processes that train together; the first of them has the `Trainer`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import torch
from rich.console import Console
from torch import Tensor

from unmix_plugin.engine.configs import AtStart, OptimizerConfig, TrainerConfig
from unmix_plugin.engine.machine import keep_freed_memory, resolve_device, seed_everything
from unmix_plugin.engine.model import TrainingCallbackLocation, run_callbacks
from unmix_plugin.engine.pipeline import Pipeline
from unmix_plugin.engine.processes import ALONE, Follower, Processes, joined, require_equal_settings
from unmix_plugin.engine.runs.atomic_files import write_run_json
from unmix_plugin.engine.runs.checkpoints import (
    AVERAGE,
    Checkpoint,
    TrainingRecord,
    collect_tensors,
    part,
    restore_training,
    save_checkpoint,
)
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.engine.runs.load_run import load_config, require_checkpoint, require_data, write_config
from unmix_plugin.engine.runs.run_folder import (
    RunFolder,
    RunLock,
    checkpoint_steps,
    create_run_folder,
    open_run_folder,
)
from unmix_plugin.engine.runs.scene_record import check_same_scene, read_scene_record, scene_record_to_json
from unmix_plugin.engine.training.optimizers import (
    AVERAGE_INTERVAL,
    GradientGuard,
    ParameterAverage,
    build_optimizer,
    forget_gradients,
    set_learning_rates,
)
from unmix_plugin.engine.training.progress import (
    Limits,
    MetricsWriter,
    ProgressConsole,
    ProgressDisplay,
    RunLog,
    TrainingClock,
    TrainingStatus,
)
from unmix_plugin.engine.training.training_control import Interrupted, StopSignals, TrainingControl
from unmix_plugin.errors import ConfigError, RunError, UnmixError


@dataclass(frozen=True)
class _StepResult:
    """What a training step gave."""

    loss: float
    """Mean over the processes."""
    values: dict[str, Tensor]
    """Losses and metrics of this process's rays without their graphs, and how many rays and samples there were."""
    num_rays: int
    """Of all processes."""
    is_refused: bool
    """Whether loss or gradients were not finite, so that nothing was updated."""
    has_reset: bool = False
    """Whether parameters were reset before it."""


class TrainingSteps:
    """Takes the training steps of one pipeline."""

    def __init__(
        self, pipeline: Pipeline, configs: Mapping[str, OptimizerConfig], processes: Processes = ALONE
    ) -> None:
        """
        Args:
            pipeline: Its model has its first values.
            configs: Settings of the optimiser by parameter group.
            processes: That take these steps together.
        Raises:
            ConfigError: a group of the model has no optimizer config.
        """
        self.pipeline, self.configs, self.processes = pipeline, configs, processes
        pipeline.model.processes = processes
        self.optimizer = build_optimizer(pipeline.model.get_param_groups(), configs)
        self.guard = GradientGuard(self.optimizer)
        self.callbacks = [
            *pipeline.datamanager.get_training_callbacks(),
            *pipeline.model.get_training_callbacks(),
        ]
        self.learning_rates: dict[str, float] = {}

    @property
    def num_rays(self) -> int:
        """Rays of the next step in all processes."""
        return self.pipeline.datamanager.get_train_rays_per_batch() * self.processes.count

    def share_rays(self, num_rays: int) -> None:
        """Let the next steps have so many rays in all processes.

        Raises:
            ConfigError: more processes than rays.
        """
        own = num_rays // self.processes.count
        if own == 0:
            raise ConfigError(
                f"{self.processes.count} processes for {num_rays} rays a step; use fewer processes"
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
        """Start all processes from the first one's model, before step number `step`.

        Raises:
            RunError: a process is at another step: their checkpoints differ.
        """
        self.processes.equalise(self.pipeline.model.state_dict().values())
        found = set(self.processes.gather(step))
        if len(found) > 1:
            raise RunError(
                f"the processes go on from checkpoints of different steps, {sorted(found)}: a run folder is "
                "not the same for all of them"
            )
        self.pipeline.draw_as(self.processes.rank)

    def take(self, step: int, progress: float) -> _StepResult:
        """Take step number `step` at `progress` in [0, 1].

        Raises:
            RunError: loss and gradients stay non-finite, or another process has ended.
        """
        pipeline, datamanager = self.pipeline, self.pipeline.datamanager
        pipeline.train()  # a guest may have left it in evaluation mode
        pipeline.seed_step(step)
        run_callbacks(self.callbacks, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step, progress)
        with torch.no_grad():
            reset = pipeline.model.between_steps(step, progress, datamanager)
        forget_gradients(self.optimizer, reset)
        num_rays = datamanager.get_train_rays_per_batch()
        self.learning_rates = set_learning_rates(self.optimizer, self.configs, progress)
        outputs, losses, metrics = pipeline.get_train_loss_dict(step)
        total = torch.stack(list(losses.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        wanted = pipeline.model.next_num_rays(outputs, num_rays)
        total, wanted = self._averaged(total, wanted)
        is_finite, loss = self.guard.check(total)
        if is_finite:
            self.optimizer.step()
        run_callbacks(self.callbacks, TrainingCallbackLocation.AFTER_TRAIN_ITERATION, step, progress)
        if wanted is not None:
            datamanager.set_train_rays_per_batch(wanted)
        counts = {"num_rays": num_rays, "num_samples": pipeline.model.num_samples(outputs)}
        values = {name: value.detach() for name, value in {**losses, **metrics}.items()}
        values.update({name: torch.tensor(float(count)) for name, count in counts.items()})
        return _StepResult(loss, values, num_rays * self.processes.count, not is_finite, bool(reset))

    def _averaged(self, total: Tensor, wanted: int | None) -> tuple[Tensor, int | None]:
        """Gradients, loss and the rays wanted for the next step, as means over the processes."""
        if self.processes.count == 1:
            return total, wanted
        parameters = [param for group in self.optimizer.param_groups for param in group["params"]]
        rays = total.new_tensor(float("nan") if wanted is None else float(wanted))
        total, rays = self.processes.average_gradients(parameters, [total, rays])
        return total, None if wanted is None else max(1, int(rays))


def _prepare_steps(
    config: TrainerConfig, processes: Processes = ALONE
) -> tuple[TrainerConfig, TrainingSteps]:
    """Read the scene and make the model; settings without `auto`, and what takes the steps.

    Raises:
        SceneError, ConfigError: scene or settings are wrong.
    """
    device = resolve_device(config.device)
    seed_everything(config.seed)
    pipeline: Pipeline = config.pipeline.setup(data=require_data(config), device=device, seed=config.seed)
    if config.load_run is None:
        pipeline.initialise()
    steps = TrainingSteps(pipeline, config.optimizers, processes)
    if processes.count > 1:
        steps.share_rays(pipeline.datamanager.get_train_rays_per_batch())
    return replace(config, pipeline=pipeline.config), steps


def _refuse_changes_at_start(before: Any, now: Any, flag: str = "--") -> None:
    """Compare the settings of a run with those to go on with. Raises ConfigError: one differs that acted at the start
    alone, and would be written down without having acted."""
    hints = get_type_hints(type(now), include_extras=True)
    for name in (entry.name for entry in fields(now)):
        old, new, own = getattr(before, name, None), getattr(now, name), flag + name.replace("_", "-")
        if is_dataclass(new):
            _refuse_changes_at_start(old, new, f"{own}.")
        elif AtStart in getattr(hints[name], "__metadata__", ()) and old != new:
            raise ConfigError(
                f"{own} is {new}, and the run to go on with was started with {old}: it acts when "
                "a run is started alone; leave it out, or start a new run"
            )


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
    """Train along with the first process, which has a `Trainer`, until it says that training is over.

    Returns:
        What took the steps, with the model as it is then.
    Raises:
        Follower: the training fails, or is stopped on request, which the first process says.
    """
    try:
        with processes.together():
            _, steps = _prepare_steps(config, processes)
        step = 0
        with processes.together():
            if config.load_run is not None:
                step = steps.restore(require_checkpoint(open_run_folder(config.load_run))).steps
        steps.pipeline.model.warm_up()
        # A terminal's Ctrl-C reaches all processes; the first decides when to stop, and saves.
        with StopSignals():
            steps.begin(step)
            while (progress := processes.announce(None)) is not None:
                steps.take(step, progress)
                step += 1
            if processes.announce(None) is None:
                raise Follower(_STOPPED)
    except UnmixError as error:
        raise Follower(2) from error
    return steps


class Trainer:
    """Trains one pipeline into one run folder.

    A step is a function of the parameters and of (seed, step) alone: every generator is seeded again before each, so a
    run stopped and resumed takes the very steps of a straight one (while limits are given in steps).
    """

    def __init__(
        self,
        config: TrainerConfig,
        *,
        console: Console | None = None,
        control: TrainingControl | None = None,
        processes: Processes = ALONE,
    ) -> None:
        """Read the scene, make the model, then make the run folder or reopen the one in `config.load_run`.

        Args:
            config: All settings; to resume, `load_config(path)`, in which limits may be changed.
            console: Where progress is shown; standard output if None.
            control: Through which other threads watch and steer this training.
            processes: That train together, of which this is the first; the others call `follow_training`.
        Raises:
            SceneError, ConfigError: scene or settings are wrong; nothing has been written.
            RunError: the run to resume is unusable, or the folder can't be made.
        """
        config_to_json(config)  # settings that can't be written down are refused before anything is
        self.console = console or ProgressConsole()
        self.control = control or TrainingControl()
        self.processes = processes
        keep_freed_memory()
        with processes.together():
            resumed = None if config.load_run is None else open_run_folder(config.load_run)
            if resumed is not None:
                _refuse_changes_at_start(load_config(resumed.path), config)
            if config.data is not None and config.data.exists():  # found from any working directory then
                config = replace(config, data=config.data.resolve())
            self.config, self.steps = _prepare_steps(config, processes)
        self.pipeline, self.optimizer = self.steps.pipeline, self.steps.optimizer
        self.callbacks, self.guard = self.steps.callbacks, self.steps.guard
        self.limits = Limits(config.max_num_iterations, config.max_seconds)
        self.clock = TrainingClock()
        self.step = 0
        """Training steps done."""
        self.total_rays = 0
        self.average = self._new_average()
        self._saved_step: int | None = None
        self._is_warm = False
        with processes.together():
            self.run = self._new_run() if resumed is None else resumed
            self.log = RunLog(self.run)
            if resumed is not None:
                self._resume()
        self.writer = MetricsWriter(self.run, self.step)
        how = "started" if resumed is None else "resumed"
        together = f", {processes.count} processes" if processes.count > 1 else ""
        self.log.write(f"{how} on {self.pipeline.model.device}, torch {torch.__version__}{together}")
        for line in self.pipeline.reasons.splitlines():
            self.log.write(line)

    @property
    def progress(self) -> float:
        """Fraction of the training done, [0, 1]."""
        return self.limits.progress(self.step, self.clock.seconds)

    @property
    def record(self) -> TrainingRecord:
        """How far training has come."""
        return TrainingRecord(
            steps=self.step,
            train_seconds=self.clock.seconds,
            total_rays=self.total_rays,
            skipped_steps=self.guard.skipped,
            num_rays=self.steps.num_rays,
            average_updates=0 if self.average is None else self.average.updates,
            progress=self.progress,
            learning_rates=self.steps.learning_rates,
        )

    def train(self) -> TrainingRecord:
        """Train to the limit, save, and write `training.json`.

        Raises:
            Interrupted: Ctrl-C, SIGTERM, SIGHUP, a stop through `control`, or nobody reads the progress any more; the
                step under way was ended and saved. A second signal stops at once, and then the newest checkpoint is
                an older one.
            RunError: the disk is full, or loss and gradients stay non-finite.
        """
        try:
            with self.control.device.training_turn():
                self.warm_up()
            self.steps.begin(self.step)
            with StopSignals() as stop, ProgressDisplay(self.console) as display, self.control.running():
                self._loop(stop, display)
        except KeyboardInterrupt as error:
            steps = checkpoint_steps(self.run.checkpoints)
            raise Interrupted(self.run.path, steps[0] if steps else None) from error
        except Interrupted:
            raise
        except Exception as error:
            with suppress(RunError):  # the disk may be full, which `error` says already
                self.log.write(f"failed at step {self.step}: {type(error).__name__}: {error}")
            raise
        else:
            write_run_json(self.run.training_path, self.record.to_json())
            self.log.write(f"finished: {self.step} steps, {self.clock.seconds:.1f} s, {self.total_rays} rays")
            return self.record
        finally:
            self.writer.close()
            self._lock.release()

    def warm_up(self) -> None:
        """Let the model compile and allocate what its first step needs, if that has not been done."""
        if not self._is_warm:
            self.pipeline.model.warm_up()
            self._is_warm = True

    def save(self) -> None:
        """Save a checkpoint of the present step.

        Raises:
            RunError: the disk is full or refuses; the previous checkpoint is as it was.
        """
        if self._saved_step == self.step:
            return
        tensors = collect_tensors(self.pipeline.model, self.optimizer, self.average)
        record, kept = self.record.to_json(), self.config.checkpoints_kept
        try:
            save_checkpoint(self.run.checkpoints, self.step, tensors, record, kept)
        except RunError as error:
            before = "What was saved before is whole: go on with --load-run"
            is_first = not checkpoint_steps(self.run.checkpoints)
            raise RunError(f"{error}. {'Nothing was saved before' if is_first else before}") from error
        self._saved_step = self.step
        self.log.write(f"saved step {self.step}")

    def _loop(self, stop: StopSignals, display: ProgressDisplay) -> None:
        was_paused = False
        while not (
            self._is_at_limit or stop.requested or self.control.is_stop_requested or display.is_closed
        ):
            if self.control.is_paused is not was_paused:
                was_paused = not was_paused
                display.message(f"{'paused' if was_paused else 'resumed'} at step {self.step}")
            if not was_paused:
                with self.control.device.training_turn():
                    self._iterate(display)
            elif self.control.wait_while_paused():
                with self.control.device.training_turn():
                    self.save()
        self.processes.announce(None)
        with self.control.device.training_turn():
            self.save()
        self.processes.announce(1.0 if self._is_at_limit else None)
        if not self._is_at_limit:
            self.control.request_stop()  # also where a signal asked for it: pages show what has become of the training
            reason = "its output is closed" if display.is_closed else "on request"
            self.log.write(f"stopped at step {self.step}: {reason}")
            raise Interrupted(self.run.path, self.step)

    def _iterate(self, display: ProgressDisplay) -> None:
        """A step, and whatever is shown, written or measured after it."""
        result = self._train_step()
        loss, metrics = result.loss, result.values
        if self.control.is_status_due or self.progress >= 1.0:
            self.control.show(self._status(loss, metrics))
        if display.is_due or self.progress >= 1.0:
            display.show(self._status(loss, metrics))
        if self._is_time_for(self.config.steps_per_log):
            numbers = {name: float(value) for name, value in metrics.items()}
            rates = {f"lr/{name}": rate for name, rate in self.steps.learning_rates.items()}
            speed = {
                "rays_per_second": self.record.train_rays_per_second,
                "skipped_steps": float(self.guard.skipped),
            }
            written = {**numbers, "loss": loss, **rates, **speed}
            self.writer.write(self.step, self.clock.seconds, "train", written)
        if self._is_time_for(self.config.steps_per_save) or self.control.take_save_request():
            self.save()
        if self._is_time_for(self.config.steps_per_eval_all_images):
            with nullcontext() if self.average is None else self.average.swapped_in():
                measured, images = self.pipeline.get_average_eval_image_metrics_and_images()
            self.writer.write(self.step, self.clock.seconds, "eval_all", measured)
            self.writer.write_images(self.step, images)
            found = ", ".join(f"{name} {value:.4g}" for name, value in measured.items())
            display.message(f"step {self.step}: evaluation views: {found}")

    @property
    def _is_at_limit(self) -> bool:
        return self.limits.reached(self.step, self.clock.seconds)

    def _train_step(self) -> _StepResult:
        with self.clock.running():
            step, progress = self.step, self.progress
            self.processes.announce(progress)
            result = self.steps.take(step, progress)
            self.step += 1
            self.total_rays += result.num_rays
            if result.has_reset:
                self.average = self._new_average()
            if self.average is not None:
                self.average.update(self.step)  # after the callbacks, which keep parameters in their bounds
        if result.is_refused:
            self.log.write(f"step {step} skipped: non-finite loss ({result.loss:g}) or gradient")
        return result

    def _status(self, loss: float, metrics: Mapping[str, Tensor]) -> TrainingStatus:
        psnr = float(metrics["psnr"]) if "psnr" in metrics else None
        speed = self.record.train_rays_per_second
        return TrainingStatus(self.step, self.clock.seconds, self.progress, loss, psnr, speed)

    def _is_time_for(self, interval: int) -> bool:
        return interval > 0 and self.step % interval == 0

    def _new_average(self) -> ParameterAverage | None:
        if self.config.average_decay is None:
            return None
        return ParameterAverage(self.pipeline.model, self.config.average_decay, AVERAGE_INTERVAL)

    def _new_run(self) -> RunFolder:
        scene = scene_record_to_json(self.pipeline.datamanager)
        data = require_data(self.config)
        run = create_run_folder(self.config.output_dir, data.resolve().name, self.config.method_name)
        self._lock = RunLock(run.path / "run.lock")
        write_run_json(run.scene_path, scene)
        write_config(run, self.config)
        return run

    def _resume(self) -> None:
        """Restore all that the newest complete checkpoint holds."""
        datamanager = self.pipeline.datamanager
        check_same_scene(read_scene_record(self.run, type(datamanager)), datamanager, self.run)
        require_checkpoint(self.run)  # before anything is written
        self._lock = RunLock(self.run.path / "run.lock")
        checkpoint = require_checkpoint(self.run)  # another training may have saved one since
        record = self.steps.restore(checkpoint)
        self.step = self._saved_step = record.steps
        self.total_rays = record.total_rays
        self.clock = TrainingClock(record.train_seconds)
        self.average = self._new_average()
        averaged = part(checkpoint.tensors, AVERAGE)
        if self.average is not None and averaged:
            self.average.restore(averaged, record.average_updates)
        write_config(self.run, self.config)
        for reason in checkpoint.damaged:
            self.log.write(f"passed over a damaged checkpoint: {reason}")
