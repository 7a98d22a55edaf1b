"""`unmix-train METHOD --data DIR`: train a method on a scene, or go on with a run.

Arguments are settings of the method, or of the run to go on with, changed by what is given. After training the course
of the loss is told in words: whether it settled, and what to try where it did not.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import tyro

from unmix_plugin.commands.entry import INTERRUPTED, run_command
from unmix_plugin.engine.configs import Common, Hidden, TrainerConfig
from unmix_plugin.engine.registry import MethodSpecification, discover_methods, find_method
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.viewer.access import TrainingViewerOptions

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.engine.training.trainer import Trainer
    from unmix_plugin.scenes.scene import Scene


_PROGRAM = "unmix-train"
_USAGE = f"""usage: {_PROGRAM} METHOD --data DIR [options]
       {_PROGRAM} METHOD --load-run RUN [options]

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
            f"say which method to train first, as in {_PROGRAM} METHOD --data DIR; installed: {installed}"
        )
    name, options = argv[0], list(argv[1:])
    method = find_method(name)
    if "--help-all" in options:
        _parse(method, method.config, ["--help"], lambda marks: Hidden not in marks)
    if {"--help", "-h"} & set(options):
        ending = " --help-all lists all options, also those of the viewer."
        _parse(method, method.config, ["--help"], lambda marks: Common in marks, ending)
    given = tyro.cli(
        _Given, args=options, prog=f"{_PROGRAM} {name}", return_unknown_args=True, add_help=False
    )[0]
    default = method.config
    if given.load_run is not None:
        from unmix_plugin.engine.runs.load_run import load_config

        default = load_config(given.load_run)
        if default.method_name != name:
            raise ConfigError(
                f"{given.load_run} is a run of {default.method_name}, not of {name}; go on with its own method"
            )
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


def _parse(
    method: MethodSpecification,
    default: TrainerConfig,
    options: list[str],
    is_shown: Callable[[Collection[Any]], bool] | None = None,
    ending: str = "",
) -> tuple[TrainerConfig, TrainingViewerOptions]:
    name, viewing = method.config.method_name, TrainingViewerOptions(enabled=sys.stdout.isatty())
    if is_shown is not None:
        default, viewing = _shown_only(default, is_shown), _shown_only(viewing, is_shown)
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


def _shown_only(config: Any, is_shown: Callable[[Collection[Any]], bool]) -> Any:
    """The same settings in classes whose help has those fields alone that are to be shown, by their annotations."""
    hints = get_type_hints(type(config), include_extras=True)
    shown: list[tuple[str, Any, Any]] = []
    values: dict[str, Any] = {}
    for entry in fields(config):
        hint, value = hints[entry.name], getattr(config, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            value = _shown_only(value, is_shown)
            hint = type(value)
        elif not is_shown(getattr(hint, "__metadata__", ())):
            hint = Annotated[hint, tyro.conf.Suppress]
        values[entry.name] = value
        shown.append((entry.name, hint, field(default_factory=lambda value=value: value)))
    return make_dataclass(type(config).__name__, shown, bases=(type(config),), frozen=True)(**values)


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
        width = max((len(name) for name in methods), default=0)
        print(_USAGE, "methods:", sep="\n")
        for name, method in sorted(methods.items()):
            print(f"  {name:{width}}  {method.description}")
        print(f"\n{_PROGRAM} METHOD --help lists the common options of a method, --help-all all of them.")
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
    """Train, and write what the model has found; exits with 130 after a stop on request."""
    from unmix_plugin.commands.reporting import say, spectral_scene
    from unmix_plugin.engine.training.training_control import Interrupted

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
    say(console, f"trained {counted(record.steps, 'step')} in {record.train_seconds:.1f} s, {speed}")
    averaged = nullcontext() if trainer.average is None else trainer.average.swapped_in()
    with trainer.control.device.training_turn(), averaged:
        trainer.pipeline.model.write_results(trainer.run.path)
    data = trainer.pipeline.datamanager
    if spectral_scene(data) is not None:  # remarks name settings of spectral methods
        num_pixels = int(data.metadata().get("num_train_pixels", 0))
        few = _remark_on_passes(record.total_rays, num_pixels)
        for remark in [*_read_remarks(trainer.run.metrics_path), *few]:
            say(console, remark)


@contextmanager
def _shown(trainer: Trainer, viewing: TrainingViewerOptions, console: Console) -> Iterator[None]:
    """Context in which the training can be watched in the browser, if it is to be."""
    if not viewing.enabled:
        yield
        return
    from unmix_plugin.commands.reporting import say, spectral_scene
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

    def scene() -> Scene:
        found = spectral_scene(trainer.pipeline.datamanager)
        if found is None:
            raise ConfigError(f"{trainer.config.method_name} has no spectral scene")
        return found

    viewer = Viewer(source, viewing, scene, lambda line: say(console, line))
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


_FEWEST_LINES = 8
"""Lines of metrics below which nothing is said."""
_OUTLIERS = 0.02
"""Share of poses that are not believed, of which more is said."""
_HARDLY_FELL = 0.6
"""Loss in the last quarter of the training, over that in the first, above which it hardly fell. Trainings that settle
stay below 0.35, also short ones."""
_STILL_FALLS = 0.3
"""Share by which the loss fell from the third to the last quarter, above which more steps are worthwhile."""

_LITTLE_MATTER = 0.02
"""Share of light from matter below which a world has nothing but a sky."""
_FEW_PASSES = 3
"""Rays for each training pixel below which fine detail is still being learnt."""


def _read_remarks(metrics_path: Path) -> list[str]:
    """Remarks on a training's `metrics.jsonl`."""
    from unmix_plugin.engine.training.progress import read_metrics

    return _remarks([line for line in read_metrics(metrics_path) if line.get("split") == "train"])


def _remarks(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on lines of training batches in order, each with `step` and `loss` (None: not finite)."""
    known = [line for line in lines if line.get("loss") is not None]
    if len(known) < _FEWEST_LINES:
        return []
    first, third, last = (_typical_loss(known, quarter) for quarter in (1, 3, 4))
    if None in (first, third, last) or not first or not third or last is None:
        return []
    found = []
    undone = int(known[-1].get("poses_undone") or 0)
    if undone:
        found.append(
            f"corrections of the poses of {counted(undone, 'view')} went beyond a quarter of the distance to the scene "
            "or too far a turn and were undone: look whether these views belong to the scene, or train with "
            "--poses fixed"
        )
    outliers = float(known[-1].get("pose_outliers") or 0)
    if outliers > _OUTLIERS:
        found.append(
            f"{outliers:.0%} of the views, or of the rows of line cameras, still fit far worse than the others and "
            "hardly shape the scene: their poses are off by more than was found, or they show something else"
        )
    matter = known[-1].get("matter_share")
    if matter is not None and matter < _LITTLE_MATTER:
        found.append(
            f"{1 - matter:.0%} of what the views show was learnt as sky: they agree on nothing nearer. If they show a "
            "scene, look whether poses belong to their pictures, or train with --world bounded"
        )
    if last > _HARDLY_FELL * first:
        found.append(
            f"the loss hardly fell: in the last quarter of the training it was {last / first:.0%} of that in the "
            "first. The views don't agree on one scene. Look at the pictures of unmix-eval: double edges mean wrong "
            "poses; blurred brightness, a light that moves (try --light camera, or --light per-view where exposures "
            "differ); bright specks, blown-out pixels or background within the masks"
        )
    elif 1 - last / third > _STILL_FALLS:
        found.append(
            f"the loss still fell by {1 - last / third:.0%} from the third to the last quarter: a longer training "
            "(--max-num-iterations, --max-seconds) will show more"
        )
    return found


def _remark_on_passes(num_rays: int, num_pixels: int) -> list[str]:
    """A remark if the training pixels were seen so rarely that more training will show more.

    Args:
        num_rays: Cast in all.
        num_pixels: Of the training views; 0 if it is not known.
    """
    if num_pixels == 0 or num_rays >= _FEW_PASSES * num_pixels:
        return []
    rays = f"{num_rays / num_pixels:.2g} rays for each training pixel"
    return [f"{rays}: a longer training (--max-num-iterations, --max-seconds) will show finer detail"]


def _typical_loss(lines: Sequence[Mapping[str, Any]], quarter: int) -> float | None:
    """Median over a quarter of the lines' time, 1 to 4; None without lines in it."""
    start, end = (lines[at]["step"] for at in (0, -1))
    low, high = (start + (end - start) * part / 4 for part in (quarter - 1, quarter))
    losses = [float(line["loss"]) for line in lines if low < line["step"] <= high]
    return median(losses) if losses else None


def main() -> None:
    """Console script."""
    run_command(train)


if __name__ == "__main__":
    main()
