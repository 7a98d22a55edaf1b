"""The arguments of `unmix-train`: settings of the method, or of the run to go on with, changed by what is given."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from unmix_plugin.engine.configs import Common, TrainerConfig
from unmix_plugin.engine.registry import MethodSpecification, discover_methods, find_method
from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.access import TrainingViewerOptions

PROGRAM = "unmix-train"
_USAGE = f"""usage: {PROGRAM} METHOD --data DIR [options]
       {PROGRAM} METHOD --load-run RUN [options]

Train a method on a folder of posed spectral images (--data demo: the built-in scene), or go on with a run.
"""


@dataclass(frozen=True)
class _Given:
    """What has to be known before the rest can be read: text, or None where it was not given."""

    load_run: Path | None = None
    max_num_iterations: str | None = None
    max_seconds: str | None = None


def parse(argv: Sequence[str]) -> TrainerConfig:
    """The settings of a training, without how it is shown: see `parse_all`.

    Raises:
        ConfigError, RunError: as there.
    """
    return parse_all(argv)[0]


def parse_all(argv: Sequence[str]) -> tuple[TrainerConfig, TrainingViewerOptions]:
    """All settings: the method's defaults, or those of the run to go on with, changed by the arguments.

    A limit given alone is the only one: with `--max-seconds` the method's number of iterations does not end training,
    with `--max-num-iterations` no time that a resumed run was given does.

    Raises:
        ConfigError: no or an unknown method, not that of the run to go on with, or impossible settings.
        RunError: the run to go on with is unusable.
        SystemExit: help was asked for (0), or arguments do not parse (2).
    """
    if not argv or argv[0].startswith("-"):
        installed = ", ".join(sorted(discover_methods()[0]))
        raise ConfigError(
            f"say which method to train first, as in {PROGRAM} METHOD --data DIR; installed: {installed}"
        )
    name, options = argv[0], list(argv[1:])
    method = find_method(name)
    if "--help-all" in options:
        _parse(method, method.config, ["--help"])
    if {"--help", "-h"} & set(options):
        _parse(method, method.config, ["--help"], only_common=True)
    given = tyro.cli(
        _Given, args=options, prog=f"{PROGRAM} {name}", return_unknown_args=True, add_help=False
    )[0]
    default = method.config if given.load_run is None else _stored_config(name, given.load_run)
    config, viewing = _parse(method, default, options)
    if given.max_num_iterations is None and given.max_seconds is not None and config.max_seconds is not None:
        config = replace(config, max_num_iterations=None)
    elif (
        given.max_seconds is None
        and given.max_num_iterations is not None
        and config.max_num_iterations is not None
    ):
        config = replace(config, max_seconds=None)
    return config, viewing


def overview(methods: dict[str, MethodSpecification]) -> str:
    """Help without a method: which there are."""
    width = max((len(name) for name in methods), default=0)
    lines = [f"  {name:{width}}  {method.description}" for name, method in sorted(methods.items())]
    ending = f"{PROGRAM} METHOD --help lists the common options of a method, --help-all all of them."
    return "\n".join([_USAGE, "methods:", *lines, "", ending])


def _parse(
    method: MethodSpecification, default: TrainerConfig, options: list[str], only_common: bool = False
) -> tuple[TrainerConfig, TrainingViewerOptions]:
    name, viewing = method.config.method_name, TrainingViewerOptions(enabled=sys.stdout.isatty())
    ending = ""
    if only_common:
        default, viewing = _common_only(default), _common_only(viewing)
        ending = " --help-all lists all options, also those of the viewer."
    settings, viewer = type(default), type(viewing)
    parts = [("config", Annotated[settings, tyro.conf.arg(name="")]), ("viewer", viewer)]
    kind = make_dataclass("Arguments", parts, frozen=True)
    found: Any = tyro.cli(
        kind,
        default=kind(default, viewing),
        args=options,
        prog=f"{PROGRAM} {name}",
        description=f"Train {name}: {method.description}.{ending}",
    )
    return found.config, found.viewer


def _stored_config(name: str, path: Path) -> TrainerConfig:
    """Settings of the run to go on with."""
    from unmix_plugin.engine.runs.load_run import load_config

    stored = load_config(path)
    if stored.method_name != name:
        raise ConfigError(
            f"{path} is a run of {stored.method_name}, not of {name}; go on with its own method"
        )
    return stored


def _common_only(config: Any) -> Any:
    """The same settings in classes whose help leaves out all fields but those annotated with `Common`."""
    hints = get_type_hints(type(config), include_extras=True)
    shown: list[tuple[str, Any, Any]] = []
    values: dict[str, Any] = {}
    for entry in fields(config):
        hint, value = hints[entry.name], getattr(config, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            value = _common_only(value)
            hint = type(value)
        elif Common not in getattr(hint, "__metadata__", ()):
            hint = Annotated[hint, tyro.conf.Suppress]
        values[entry.name] = value
        shown.append((entry.name, hint, field(default_factory=lambda value=value: value)))
    return make_dataclass(type(config).__name__, shown, bases=(type(config),), frozen=True)(**values)
