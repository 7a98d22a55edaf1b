"""The training loop of one run: its steps, and what is saved, shown and measured between them."""

from __future__ import annotations

import signal
import time
from contextlib import nullcontext, suppress
from dataclasses import replace

import torch
from rich.console import Console

from unmix_plugin.engine.configs import TrainerConfig, refuse_changes_at_start
from unmix_plugin.engine.decisions import decision_table
from unmix_plugin.engine.machine import keep_freed_memory
from unmix_plugin.engine.processes import ALONE, Processes
from unmix_plugin.engine.registry import discover_methods
from unmix_plugin.engine.runs.checkpoints import (
    AVERAGE,
    TrainingRecord,
    collect_tensors,
    newest_complete_checkpoint,
    part,
    require_sound,
    save_checkpoint,
)
from unmix_plugin.engine.runs.config_json import require_kept
from unmix_plugin.engine.runs.loading import read_config, require_data, write_config
from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.engine.runs.run_folder import (
    RunFolder,
    RunLock,
    checkpoint_steps,
    create_run_folder,
    open_run_folder,
)
from unmix_plugin.engine.runs.run_json import adopt_run_json, write_run_json
from unmix_plugin.engine.runs.scene_record import check_same_scene, read_scene_record, scene_record_to_json
from unmix_plugin.engine.training.optimizers import AVERAGE_INTERVAL, ParameterAverage
from unmix_plugin.engine.training.progress import (
    MetricsWriter,
    ProgressConsole,
    ProgressDisplay,
    TrainingStatus,
    write_event,
)
from unmix_plugin.engine.training.steps import StepResult, prepare_steps
from unmix_plugin.engine.training.training_control import Interrupted, TrainingControl, stop_signals
from unmix_plugin.errors import RunError


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
            RunError: the run to resume is unusable, the model's values are not finite, or the folder can't be made.
        """
        known = discover_methods()[0].get(config.method_name)
        require_kept(config, config if known is None else known.config)
        self.console = console or ProgressConsole()
        self.control = control or TrainingControl()
        self.processes = processes
        with processes.together():
            resumed = None if config.load_run is None else open_run_folder(config.load_run)
            if resumed is not None:
                refuse_changes_at_start(read_config(resumed), config)
            if config.data is not None and config.data.exists():  # found from any working directory then
                config = replace(config, data=config.data.resolve())
            self.config, self.steps = prepare_steps(config, processes)
        self.pipeline, self.optimizer = self.steps.pipeline, self.steps.optimizer
        self.callbacks = self.steps.callbacks
        self.step, self.seconds, self.total_rays = 0, 0.0, 0
        """Steps, seconds of training alone, and rays done."""
        self.average = self._new_average()
        self._saved_step: int | None = None
        self._is_warm = False
        with processes.together():
            self.run = self._new_run() if resumed is None else resumed
            if resumed is not None:
                self._resume()
        self.writer = MetricsWriter(self.run, self.step)
        how = "started" if resumed is None else "resumed"
        together = f", {processes.count} processes" if processes.count > 1 else ""
        self._log(f"{how} on {self.pipeline.model.device}, torch {torch.__version__}{together}")
        for line in (*self.pipeline.reasons.splitlines(), *decision_table(self.pipeline.decisions)):
            self._log(line)

    @property
    def progress(self) -> float:
        """Fraction of the training done, [0, 1]."""
        return self.config.progress(self.step, self.seconds)

    @property
    def record(self) -> TrainingRecord:
        """How far training has come."""
        return TrainingRecord(
            steps=self.step,
            train_seconds=self.seconds,
            total_rays=self.total_rays,
            skipped_steps=self.steps.guard.skipped,
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
        signals: list[int] = []
        keep_freed_memory()  # not while the scene is read, whose largest arrays are gone before training begins
        try:
            with self.control.device.training_turn():
                self.warm_up()
            self.steps.begin(self.step)
            adopt_run_json(self.run.training_path)
            remove(self.run.training_path)  # of the training that this one goes on with
            with stop_signals(signals), ProgressDisplay(self.console) as display, self.control.running():
                self._loop(signals, display)
        except KeyboardInterrupt as error:
            steps = checkpoint_steps(self.run.checkpoints)
            first = signals[0] if signals else signal.SIGINT
            raise Interrupted(self.run.path, steps[0] if steps else None, first) from error
        except Interrupted:
            raise
        except Exception as error:
            with suppress(RunError):  # the disk may be full, which `error` says already
                self._log(f"failed at step {self.step}: {type(error).__name__}: {error}")
            raise
        else:
            write_run_json(self.run.training_path, self.record.to_json())
            self._log(f"finished: {self.step} steps, {self.seconds:.1f} s, {self.total_rays} rays")
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
        self._log(f"saved step {self.step}")

    def _loop(self, signals: list[int], display: ProgressDisplay) -> None:
        control, was_paused = self.control, False
        while self.progress < 1.0 and not (signals or control.is_stop_requested or display.is_closed):
            if control.is_paused is not was_paused:
                was_paused = not was_paused
                display.message(f"{'paused' if was_paused else 'resumed'} at step {self.step}")
            if not was_paused:
                with control.device.training_turn():
                    self._iterate(display)
            elif control.wait_while_paused():
                with control.device.training_turn():
                    self.save()
        is_over = self.progress >= 1.0
        self.processes.announce(None)
        with control.device.training_turn():
            self.save()
        self.processes.announce(1.0 if is_over else None)
        if not is_over:
            control.request_stop()  # also where a signal asked for it: pages show what has become of the training
            reason = "its output is closed" if display.is_closed else "on request"
            self._log(f"stopped at step {self.step}: {reason}")
            raise Interrupted(self.run.path, self.step, signals[0] if signals else None)

    def _iterate(self, display: ProgressDisplay) -> None:
        """A step, and whatever is shown, written or measured after it."""
        result = self._train_step()
        is_last, record = self.progress >= 1.0, self.record
        for shown in (self.control, display):
            if shown.is_due or is_last:
                psnr = float(result.values["psnr"]) if "psnr" in result.values else None
                shown.show(
                    TrainingStatus(
                        self.step,
                        self.seconds,
                        self.progress,
                        result.loss,
                        psnr,
                        record.train_rays_per_second,
                    )
                )
        if self._is_time_for(self.config.steps_per_log):
            written = {name: float(value) for name, value in result.values.items()}
            written |= {"loss": result.loss}
            written |= {f"lr/{name}": rate for name, rate in record.learning_rates.items()}
            written["rays_per_second"] = record.train_rays_per_second
            written["skipped_steps"] = float(record.skipped_steps)
            self.writer.write(self.step, self.seconds, "train", written)
        if self.control.take_save_request() or self._is_time_for(self.config.steps_per_save):
            self.save()
        if self._is_time_for(self.config.steps_per_eval_all_images):
            with nullcontext() if self.average is None else self.average.swapped_in():
                measured, images = self.pipeline.get_average_eval_image_metrics_and_images()
            self.writer.write(self.step, self.seconds, "eval_all", measured)
            self.writer.write_images(self.step, images)
            found = ", ".join(f"{name} {value:.4g}" for name, value in measured.items())
            display.message(f"step {self.step}: evaluation views: {found}")

    def _train_step(self) -> StepResult:
        started = time.perf_counter()
        step, progress = self.step, self.progress
        self.processes.announce(progress)
        result = self.steps.take(step, progress)
        self.step += 1
        self.total_rays += result.num_rays
        if result.has_reset:
            self.average = self._new_average()
        if self.average is not None:
            self.average.update(self.step)  # after the callbacks, which keep parameters in their bounds
        self.seconds += time.perf_counter() - started
        if result.is_refused:
            self._log(f"step {step} skipped: non-finite loss ({result.loss:g}) or gradient")
        return result

    def _is_time_for(self, interval: int) -> bool:
        return interval > 0 and self.step % interval == 0

    def _log(self, text: str) -> None:
        write_event(self.run, text)

    def _new_average(self) -> ParameterAverage | None:
        if self.config.average_decay is None:
            return None
        return ParameterAverage(self.pipeline.model, self.config.average_decay, AVERAGE_INTERVAL)

    def _new_run(self) -> RunFolder:
        require_sound(collect_tensors(self.pipeline.model, self.optimizer, None))
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
        newest_complete_checkpoint(self.run.checkpoints)  # before anything is written
        self._lock = RunLock(self.run.path / "run.lock")
        # Another training may have saved one since.
        checkpoint = newest_complete_checkpoint(self.run.checkpoints)
        record = self.steps.restore(checkpoint)
        self.step = self._saved_step = record.steps
        self.seconds, self.total_rays = record.train_seconds, record.total_rays
        self.average = self._new_average()
        averaged = part(checkpoint.tensors, AVERAGE)
        if self.average is not None and averaged:
            self.average.restore(averaged, record.average_updates)
        write_config(self.run, self.config)
        self.pipeline.warn(*(f"passed over a damaged checkpoint: {reason}" for reason in checkpoint.damaged))
