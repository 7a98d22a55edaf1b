"""`unmix-train METHOD --data DIR`: train a method on a scene, or go on with a run."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING

from unmix_plugin.commands.entry import INTERRUPTED, run_command
from unmix_plugin.commands.train_arguments import PROGRAM, overview, parse_all
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.registry import discover_methods
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.viewer.access import TrainingViewerOptions

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.engine.training.trainer import Trainer
    from unmix_plugin.scenes.scene import Scene


def train(argv: list[str]) -> None:
    """Parse the arguments, train, say where the run is.

    Raises:
        ConfigError: no or an unknown method, or impossible settings.
        SystemExit: help was asked for (0), arguments that do not parse (2), or a stop on request (130).
    """
    methods, broken = discover_methods()
    for plugin in broken:
        print(f"warning: {plugin}", file=sys.stderr)
    if argv and argv[0] in ("-h", "--help", "--help-all"):
        print(overview(methods))
        return
    config, viewing = parse_all(argv)

    from unmix_plugin.engine.processes import start_together
    from unmix_plugin.engine.training.progress import ProgressConsole
    from unmix_plugin.engine.training.trainer import follow_training, joined_training

    start_together("unmix_plugin.commands.train", argv, config.machine.num_devices)
    with joined_training(config) as processes:
        if not processes.is_first:
            follow_training(config, processes)
            return
        console = ProgressConsole()
        trainer = _prepared(config, console, processes)
        with _shown(trainer, viewing, console):
            _run(trainer, console)
        print(f"run: {trainer.run.path}", flush=True)


def _prepared(config: TrainerConfig, console: Console, processes: Processes) -> Trainer:
    """The trainer, with everything read and compiled that training needs."""
    from unmix_plugin.commands.reporting import announce_kernel_compilation, say, working
    from unmix_plugin.engine.training.trainer import Trainer

    with nullcontext() if config.data is None else working(console, f"reading {config.data}"):
        trainer = Trainer(config, console=console, processes=processes)
    if trainer.pipeline.reasons:
        say(console, trainer.pipeline.reasons)
    with announce_kernel_compilation(console):
        trainer.warm_up()
    data = trainer.pipeline.datamanager
    say(
        console,
        f"{counted(len(data.train_cameras), 'view')} to train on, {len(data.eval_cameras)} for evaluation; "
        f"computing on {trainer.pipeline.model.device}",
    )
    if trainer.limits.reached(trainer.step, trainer.clock.seconds):
        say(
            console,
            f"nothing to train: the run is at its limit, with {trainer.step} steps in {trainer.clock.seconds:.1f} s; "
            "give a larger --max-num-iterations or --max-seconds",
        )
    return trainer


def _run(trainer: Trainer, console: Console) -> None:
    """Train and write the endmembers.

    Raises:
        SystemExit: 130, after a stop on request.
    """
    from unmix_plugin.commands.reporting import say
    from unmix_plugin.commands.run_choice import spectral_scene
    from unmix_plugin.commands.training_remarks import read_remarks
    from unmix_plugin.engine.training.training_control import Interrupted

    try:
        record = trainer.train()
    except Interrupted as stop:
        print(stop, file=sys.stderr)
        if stop.step is not None:
            resume = shlex.join([PROGRAM, trainer.config.method_name, "--load-run", str(stop.run)])
            print(f"go on with: {resume}", file=sys.stderr)
        print(f"run: {stop.run}", flush=True)
        sys.exit(INTERRUPTED)
    speed = f"{record.train_rays_per_second:,.0f} rays/s"
    say(console, f"trained {counted(record.steps, 'step')} in {record.train_seconds:.1f} s, {speed}")
    if spectral_scene(trainer.pipeline.datamanager) is not None:  # remarks name settings of spectral methods
        for remark in read_remarks(trainer.run.metrics_path):
            say(console, remark)
    _write_endmembers(trainer)


@contextmanager
def _shown(trainer: Trainer, viewing: TrainingViewerOptions, console: Console) -> Iterator[None]:
    """Context in which the training can be watched in the browser, if it is to be.

    Raises:
        ConfigError: nothing can listen at the address.
    """
    if not viewing.enabled:
        yield
        return
    from unmix_plugin.commands.reporting import say
    from unmix_plugin.engine.runs.load_run import read_scene_record
    from unmix_plugin.viewer.rendering.scene import source_of_training
    from unmix_plugin.viewer.server import Viewer

    try:
        source = source_of_training(trainer, read_scene_record(trainer.run))
    except ConfigError as error:
        say(console, f"no viewer: {error}")
        yield
        return
    source.device.guest_share = viewing.share
    viewer = Viewer(source, viewing, lambda: _scene_of(trainer), lambda line: say(console, line))
    viewer.start()
    try:
        yield
        if viewing.keep_open or viewer.num_clients:
            until = "" if viewing.keep_open else " while a page is"
            say(console, f"training is done, the viewer stays open{until}; end it with Ctrl-C")
            with suppress(KeyboardInterrupt):
                viewer.wait(while_watched=not viewing.keep_open)
    finally:
        viewer.stop()


def _scene_of(trainer: Trainer) -> Scene:
    """The scene under training.

    Raises:
        ConfigError: its data manager has none.
    """
    from unmix_plugin.commands.run_choice import spectral_scene

    scene = spectral_scene(trainer.pipeline.datamanager)
    if scene is None:
        raise ConfigError(f"{trainer.config.method_name} has no spectral scene")
    return scene


def _write_endmembers(trainer: Trainer) -> None:
    """Write the endmembers that evaluation and exports will use, if the method has any."""
    from unmix_plugin.spectral.materials import Materials
    from unmix_plugin.trained.run_materials import write_endmembers_csv

    averaged = nullcontext() if trainer.average is None else trainer.average.swapped_in()
    with trainer.control.device.training_turn(), averaged:
        materials = getattr(trainer.pipeline.model, "materials", None)
        if isinstance(materials, Materials):
            write_endmembers_csv(trainer.run.path / "endmembers.csv", materials)


def main() -> None:
    """Console script."""
    run_command(train)


if __name__ == "__main__":
    main()
