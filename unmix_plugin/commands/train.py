"""`unmix-train METHOD --data DIR`: train a method on a scene, or go on with a run."""

from __future__ import annotations

import shlex
import sys
from contextlib import nullcontext
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from unmix_plugin.commands.entry import INTERRUPTED, run_command
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.registry import MethodSpecification, discover_methods, find_method
from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.trainer import Trainer

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
    from rich.console import Console

    methods, broken = discover_methods()
    for plugin in broken:
        print(f"warning: {plugin}", file=sys.stderr)
    if words and words[0] in ("-h", "--help"):
        print(_overview(methods))
        return
    config = parse(words)
    console = Console()
    trainer = _prepared(config, console)
    _run(trainer, console)
    print(f"run: {trainer.run.path}", flush=True)


def parse(words: list[str]) -> TrainerConfig:
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
    config = tyro.cli(
        type(default),
        default=default,
        args=options,
        prog=f"{_PROGRAM} {name}",
        description=f"Train {name}: {method.description}.",
    )
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
    from unmix_plugin.engine.load_run import load_config

    stored = load_config(Path(path))
    if stored.method_name != name:
        raise ConfigError(
            f"{path} is a run of {stored.method_name}, not of {name}; go on with its own method"
        )
    return stored


def _prepared(config: TrainerConfig, console: Console) -> Trainer:
    """The trainer, with everything read and compiled that training needs."""
    from unmix_plugin.commands.reporting import say, working
    from unmix_plugin.engine.trainer import Trainer

    reading = working(console, f"reading {config.data}") if config.data is not None else nullcontext()
    with reading:
        trainer = Trainer(config, console=console)
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
    from unmix_plugin.engine.interrupts import Interrupted

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


def _write_endmembers(trainer: Trainer) -> None:
    """Write the endmembers that evaluation and exports will use, if the method has any."""
    from unmix_plugin.exports.run_materials import has_materials, materials_of, write_endmembers_csv

    model = trainer.pipeline.model
    if has_materials(model):
        with nullcontext() if trainer.average is None else trainer.average.swapped_in():
            write_endmembers_csv(trainer.run.path / "endmembers.csv", materials_of(model))


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
