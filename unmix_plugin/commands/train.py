"""`unmix-train METHOD --data DIR`: train a method on a scene, or go on with a run.

Arguments are settings of the method, or of the run to go on with, changed by what is given.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, make_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from unmix_plugin.commands.entry import INTERRUPTED, run_command
from unmix_plugin.commands.training import finish, first_config, prepare, with_limits_given
from unmix_plugin.engine.configs import CommonFlag, Setting, TrainerConfig, UnlistedFlag, map_settings
from unmix_plugin.engine.printing import tell
from unmix_plugin.engine.registry import MethodSpecification, discover_methods, find_method
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.access import TrainingViewerOptions

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.training.trainer import Trainer
    from unmix_plugin.scenes.scene import Scene


_PROGRAM, _EXPLAIN = "unmix-train", "--explain"
_USAGE = f"""usage: {_PROGRAM} METHOD --data DIR [options]
       {_PROGRAM} METHOD --load-run RUN [options]
       {_PROGRAM} METHOD --data DIR --explain [options]

Train a method on a folder of posed spectral images (--data demo: the built-in scene), or go on with a run. With
--explain, decide all that a training would decide from the images, print it with the evidence, and train nothing.
"""


@dataclass(frozen=True)
class _Given:
    """What has to be known before the rest can be read: text, or None where it was not given."""

    load_run: Path | None = None
    max_num_iterations: str | None = None
    max_seconds: str | None = None


def parse(argv: Sequence[str]) -> tuple[TrainerConfig, TrainingViewerOptions]:
    """All settings: the method's defaults, or those of the run to go on with, changed by the arguments.

    A limit given alone is the only one: with `--max-seconds` the method's number of iterations does not end training,
    with `--max-num-iterations` no time that a resumed run was given does. Help, and arguments that do not parse, exit.
    """
    if not argv or argv[0].startswith("-"):
        installed = ", ".join(sorted(discover_methods()[0]))
        raise ConfigError(
            f"say which method to train first, as in {_PROGRAM} METHOD --data DIR; installed: {installed}"
        )
    name, options = argv[0], list(argv[1:])
    method = find_method(name)
    explains = f" {_EXPLAIN} prints all decisions and trains nothing."
    if "--help-all" in options:
        _parse(method, method.config, ["--help"], lambda marks: UnlistedFlag not in marks, explains)
    if {"--help", "-h"} & set(options):
        ending = f" --help-all lists all options, also those of the viewer;{explains}"
        _parse(method, method.config, ["--help"], lambda marks: CommonFlag in marks, ending)
    given = tyro.cli(
        _Given, args=options, prog=f"{_PROGRAM} {name}", return_unknown_args=True, add_help=False
    )[0]
    config, viewing = _parse(method, first_config(method, given.load_run), options)
    steps, seconds = given.max_num_iterations is not None, given.max_seconds is not None
    return with_limits_given(config, steps=steps, seconds=seconds), viewing


def _parse(
    method: MethodSpecification,
    default: TrainerConfig,
    options: list[str],
    is_shown: Callable[[Collection[Any]], bool] | None = None,
    ending: str = "",
) -> tuple[TrainerConfig, TrainingViewerOptions]:
    name, viewing = method.config.method_name, TrainingViewerOptions(enabled=sys.stdout.isatty())
    if is_shown is not None:

        def with_help(setting: Setting) -> Setting:
            if is_shown(setting.marks):
                return setting
            return replace(setting, hint=Annotated[setting.hint, tyro.conf.Suppress])

        default, viewing = map_settings(default, with_help), map_settings(viewing, with_help)
    settings, viewer = type(default), type(viewing)
    parts = [("config", Annotated[settings, tyro.conf.arg(name="")]), ("viewer", viewer)]
    kind = make_dataclass("Arguments", parts, frozen=True)
    found: Any = tyro.cli(
        kind,
        default=kind(default, viewing),
        args=options,
        prog=f"{_PROGRAM} {name}",
        description=f"Train {name}: {method.description}.{ending}",
    )
    return found.config, found.viewer


def train(argv: list[str]) -> None:
    """Parse the arguments, train, say where the run is."""
    methods, broken = discover_methods()
    for plugin in broken:
        tell(f"warning: {plugin}", file=sys.stderr)
    if argv and argv[0] in ("-h", "--help", "--help-all"):
        width = max((len(name) for name in methods), default=0)
        tell(f"{_USAGE}\nmethods:")
        for name, method in sorted(methods.items()):
            tell(f"  {name:{width}}  {method.description}")
        tell(f"\n{_PROGRAM} METHOD --help lists the common options of a method, --help-all all of them.")
        return
    if _EXPLAIN in argv:
        explain(parse([word for word in argv if word != _EXPLAIN])[0])
        return
    config, viewing = parse(argv)

    from unmix_plugin.commands.reporting import shell_line
    from unmix_plugin.engine.processes import start_together
    from unmix_plugin.engine.training.progress import ProgressConsole
    from unmix_plugin.engine.training.steps import follow_training, joined_training
    from unmix_plugin.engine.training.training_control import Interrupted

    start_together("unmix_plugin.commands.train", argv, config.machine.num_devices)
    with joined_training(config) as processes:
        if not processes.is_first:
            follow_training(config, processes)
            return
        console = ProgressConsole()
        trainer = prepare(config, console, processes)
        with _shown(trainer, viewing, console):
            try:
                finish(trainer, console)
            except Interrupted as stop:
                tell(stop, file=sys.stderr)
                if stop.step is not None:
                    resume = shell_line(_PROGRAM, config.method_name, "--load-run", stop.run)
                    tell(f"go on with: {resume}", file=sys.stderr)
                tell(f"run: {stop.run}")
                sys.exit(INTERRUPTED if stop.signal_number is None else 128 + stop.signal_number)
        tell(f"run: {trainer.run.path}")


def explain(config: TrainerConfig) -> None:
    """Read the scene, print what a training would decide from it and its warnings; nothing is written. ConfigError for
    a run to go on with, whose decisions are in its run.log."""
    from unmix_plugin.commands.reporting import announce_kernel_compilation, working
    from unmix_plugin.engine.decisions import decision_table
    from unmix_plugin.engine.training.progress import ProgressConsole
    from unmix_plugin.engine.training.steps import prepare_steps

    if config.load_run is not None:
        raise ConfigError(
            f"--explain decides for a new run; what {config.load_run} decided is in its run.log"
        )
    console = ProgressConsole()
    with working(console, f"reading {config.data}"), announce_kernel_compilation(console):
        pipeline = prepare_steps(config)[1].pipeline
    tell("\n".join([*pipeline.reasons.splitlines(), "", *decision_table(pipeline.decisions)]))


@contextmanager
def _shown(trainer: Trainer, viewing: TrainingViewerOptions, console: Console) -> Iterator[None]:
    """Context in which the training can be watched in the browser, if it is to be."""
    if not viewing.enabled:
        yield
        return
    from unmix_plugin.commands.reporting import say, spectral_scene
    from unmix_plugin.engine.runs.loading import read_scene_record
    from unmix_plugin.viewer.rendering.scene import source_of_training
    from unmix_plugin.viewer.server import Viewer
    from unmix_plugin.viewer.session import Services

    try:
        source = source_of_training(trainer, read_scene_record(trainer.run))
    except ConfigError as error:
        say(console, f"no viewer: {error}")
        yield
        return
    source.device.viewing_share = viewing.share

    def scene() -> Scene:
        found = spectral_scene(trainer.pipeline.datamanager)
        if found is None:
            raise ConfigError(f"{trainer.config.method_name} has no spectral scene")
        return found

    services = Services(source, scene, environments=viewing.environments)
    viewer = Viewer(services, viewing, partial(say, console))
    viewer.start()
    try:
        yield
        if viewing.keep_open or viewer.sessions:
            until = "" if viewing.keep_open else " while a page is"
            say(console, f"training is done, the viewer stays open{until}; end it with Ctrl-C")
            with suppress(KeyboardInterrupt):
                viewer.wait(while_watched=not viewing.keep_open)
    finally:
        viewer.stop()


if __name__ == "__main__":  # of one of several processes
    run_command(train)
