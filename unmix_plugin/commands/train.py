"""`unmix-train METHOD --data DIR`: train a method on a scene, or go on with a run."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import make_dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from unmix_plugin.commands.entry import INTERRUPTED, run_command
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.registry import MethodSpecification, discover_methods, find_method
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.options import TrainingViewerOptions

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.training.trainer import Trainer
    from unmix_plugin.scenes.scene import Scene

_PROGRAM = "unmix-train"
_USAGE = f"""usage: {_PROGRAM} METHOD --data DIR [options]
       {_PROGRAM} METHOD --load-run RUN [options]

Train a method on a folder of posed spectral images (--data demo: the built-in scene), or go on with a run.
"""


def train(words: list[str]) -> None:
    """Parse the words, train, say where the run is.

    Raises:
        ConfigError: no or an unknown method, or impossible settings.
        SystemExit: help was asked for (0), words that do not parse (2), or a stop on request (130).
    """
    from unmix_plugin.engine.training.progress import ProgressConsole

    methods, broken = discover_methods()
    for plugin in broken:
        print(f"warning: {plugin}", file=sys.stderr)
    if words and words[0] in ("-h", "--help"):
        print(_overview(methods))
        return
    config, viewing = parse_all(words)
    console = ProgressConsole()
    trainer = _prepared(config, console)
    with _shown(trainer, viewing, console):
        _run(trainer, console)
    print(f"run: {trainer.run.path}", flush=True)


def parse(words: list[str]) -> TrainerConfig:
    """The settings of a training, without how it is shown: see `parse_all`.

    Raises:
        ConfigError, RunError: as there.
    """
    return parse_all(words)[0]


def parse_all(words: list[str]) -> tuple[TrainerConfig, TrainingViewerOptions]:
    """All settings: the method's defaults, or those of the run to go on with, changed by the words given.

    A limit given alone is the only one: with `--max-seconds` the method's number of iterations does not end training,
    with `--max-num-iterations` no time that a resumed run was given does.

    Raises:
        ConfigError: no or an unknown method, not that of the run to go on with, or impossible settings.
        RunError: the run to go on with is unusable.
    """
    if not words or words[0].startswith("-"):
        installed = ", ".join(sorted(discover_methods()[0]))
        raise ConfigError(
            f"say which method to train first, as in {_PROGRAM} METHOD --data DIR; installed: {installed}"
        )
    name, options = words[0], words[1:]
    method = find_method(name)
    default = _stored_config(name, options) or method.config
    viewing = TrainingViewerOptions(enabled=sys.stdout.isatty())
    found: Any = tyro.cli(
        _words_of(type(default)),
        default=_words_of(type(default))(default, viewing),
        args=options,
        prog=f"{_PROGRAM} {name}",
        description=f"Train {name}: {method.description}.",
    )
    return _with_given_limit(found.config, options), found.viewer


def _words_of(kind: type[TrainerConfig]) -> type[Any]:
    """What the command takes: the settings of a training as they are, and those of the viewer under their name."""
    fields = [("config", Annotated[kind, tyro.conf.arg(name="")]), ("viewer", TrainingViewerOptions)]
    return make_dataclass("TrainWords", fields, frozen=True)


def _with_given_limit(config: TrainerConfig, options: list[str]) -> TrainerConfig:
    """The config with the other limit lifted where one limit was given alone."""
    has_iterations, has_seconds = (_is_given(flag, options) for flag in ("max-num-iterations", "max-seconds"))
    if has_seconds and not has_iterations and config.max_seconds is not None:
        return replace(config, max_num_iterations=None)
    if has_iterations and not has_seconds and config.max_num_iterations is not None:
        return replace(config, max_seconds=None)
    return config


def _overview(methods: dict[str, MethodSpecification]) -> str:
    """Help without a method: which there are."""
    width = max((len(name) for name in methods), default=0)
    lines = [f"  {name:{width}}  {method.description}" for name, method in sorted(methods.items())]
    return "\n".join(
        [_USAGE, "methods:", *lines, "", f"{_PROGRAM} METHOD --help lists all options of a method."]
    )


def _stored_config(name: str, options: list[str]) -> TrainerConfig | None:
    """Settings of the run that `--load-run` names; None without one."""
    path = _value_of("load-run", options)
    if path is None:
        return None
    from unmix_plugin.engine.runs.load_run import load_config

    stored = load_config(Path(path))
    if stored.method_name != name:
        raise ConfigError(
            f"{path} is a run of {stored.method_name}, not of {name}; go on with its own method"
        )
    return stored


def _prepared(config: TrainerConfig, console: Console) -> Trainer:
    """The trainer, with everything read and compiled that training needs."""
    from unmix_plugin.commands.reporting import say, working
    from unmix_plugin.engine.training.trainer import Trainer

    reading = working(console, f"reading {config.data}") if config.data is not None else nullcontext()
    with reading:
        trainer = Trainer(config, console=console)
    if trainer.pipeline.reasons:
        say(console, trainer.pipeline.reasons)
    with working(console, "compiling kernels (once on a machine)"):
        trainer.pipeline.model.warm_up()
    num_train, num_eval = (
        len(cameras)
        for cameras in (trainer.pipeline.datamanager.train_cameras, trainer.pipeline.datamanager.eval_cameras)
    )
    say(
        console,
        f"{num_train} views to train on, {num_eval} for evaluation; computing on {trainer.pipeline.model.device}",
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
    from unmix_plugin.engine.training.interrupts import Interrupted

    try:
        record = trainer.train()
    except Interrupted as stop:
        print(stop, file=sys.stderr)
        if stop.step is not None:
            resume = shlex.join([_PROGRAM, trainer.config.method_name, "--load-run", str(stop.run)])
            print(f"go on with: {resume}", file=sys.stderr)
        print(f"run: {stop.run}", flush=True)
        sys.exit(INTERRUPTED)
    speed = f"{record.train_rays_per_second:,.0f} rays/s"
    say(console, f"trained {record.steps} steps in {record.train_seconds:.1f} s, {speed}")
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
    from unmix_plugin.viewer.rendering.scene_source import source_of_training
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
    from unmix_plugin.scenes.scene import Scene

    scene = getattr(trainer.pipeline.datamanager, "scene", None)
    if not isinstance(scene, Scene):
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


def _is_given(flag: str, options: list[str]) -> bool:
    return any(_flag_of(word) == flag for word in options)


def _value_of(flag: str, options: list[str]) -> str | None:
    """The value after `--flag` or `--flag=`, the last one if there are several; None without one."""
    found = None
    for word, following in zip_longest(options, options[1:]):
        if _flag_of(word) == flag:
            found = word.partition("=")[2] if "=" in word else following
    return found


def _flag_of(word: str) -> str | None:
    """`max-seconds` of `--max-seconds`, `--max_seconds` and `--max-seconds=60`; None for other words."""
    return word[2:].partition("=")[0].replace("_", "-") if word.startswith("--") else None


def main() -> None:
    """Console script."""
    run_command(train)
