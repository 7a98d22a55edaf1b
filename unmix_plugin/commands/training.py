"""A training from its settings to its run: what `unmix-train` and `unmix_plugin.train` share.

After training the course of the loss is put into words: whether it settled, and what to try where it did not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import tyro

from unmix_plugin.engine.configs import Setting, TrainerConfig, map_settings, settings_of
from unmix_plugin.engine.printing import tell
from unmix_plugin.engine.registry import MethodSpecification, find_method
from unmix_plugin.errors import ConfigError, counted, did_you_mean

if TYPE_CHECKING:
    from rich.console import Console

    from unmix_plugin.engine.processes import Processes
    from unmix_plugin.engine.runs.checkpoints import TrainingRecord
    from unmix_plugin.engine.training.trainer import Trainer
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.trained.protocol import RenderableScene


def train(
    scene: str | Path | None,
    method: str = "unmix-nerf",
    *,
    load_run: str | Path | None = None,
    **settings: Any,
) -> RenderableScene:
    """Train a method on a scene, as `unmix-train METHOD --data SCENE` does, and open the run.

    Progress, remarks and the run folder are printed as the command prints them. Ctrl-C saves and raises
    KeyboardInterrupt.

    Args:
        scene: Its folder, or `demo`; None with `load_run`: where it was.
        method: A name that `unmix-train --help` lists.
        load_run: Run folder to go on with instead of starting a new one.
        settings: By the names of the flags, as in `endmembers=4, max_seconds=60`; those with dots as in
            `**{"pipeline.model.losses.rgb": 0.5}`. Of the two limits, one given alone is the only one.
    Returns:
        A `TrainedScene`, or what another method shows.
    Raises:
        ConfigError: an unknown method or setting (with the nearest names), an impossible value, or no scene.
        SceneError, RunError: as the command would end with.
    """
    from unmix_plugin.engine.training.progress import ProgressConsole
    from unmix_plugin.engine.training.training_control import Interrupted
    from unmix_plugin.trained.open_run import load_run as open_loaded

    if scene is not None and settings.setdefault("data", scene) != scene:
        raise ConfigError(f"the scene is {scene}, and data is {settings['data']}: give one of them")
    first = first_config(find_method(method), None if load_run is None else Path(load_run))
    config = _with_settings(first, settings)
    if config.machine.num_devices > 1:
        raise ConfigError("machine.num_devices is for unmix-train: one Python process trains on one device")
    console = ProgressConsole()
    trainer = prepare(config, console)
    try:
        finish(trainer, console)
    except Interrupted as stop:
        again = f"train(None, {method!r}, load_run={str(stop.run)!r})"
        raise KeyboardInterrupt(f"{stop}; go on with {again}") from stop
    tell(f"run: {trainer.run.path}")
    return open_loaded(trainer.run.path, config.device).scene


def first_config(method: MethodSpecification, load_run: Path | None) -> TrainerConfig:
    """The method's defaults, or the settings of the run to go on with, which must be of this method."""
    if load_run is None:
        return method.config
    from unmix_plugin.engine.runs.loading import load_config

    config = load_config(load_run)
    if config.method_name != method.name:
        raise ConfigError(
            f"{load_run} is a run of {config.method_name}, not of {method.name}; go on with its own method"
        )
    return config


def with_limits_given(config: TrainerConfig, *, steps: bool, seconds: bool) -> TrainerConfig:
    """The settings with a limit that was given alone as the only one: that of the method, or of the run to go on with,
    no longer ends training."""
    if seconds and not steps and config.max_seconds is not None:
        return replace(config, max_num_iterations=None)
    if steps and not seconds and config.max_num_iterations is not None:
        return replace(config, max_seconds=None)
    return config


def _with_settings(config: TrainerConfig, settings: Mapping[str, Any]) -> TrainerConfig:
    """The settings changed by name, as the command line names them; hyphens and underscores are alike."""
    from unmix_plugin.engine.runs.config_json import config_to_json, value_from_json

    known: dict[str, tuple[str, ...]] = {}
    for setting in settings_of(config):
        if tyro.conf.Suppress not in setting.marks:
            aliases = [alias for mark in setting.marks for alias in getattr(mark, "aliases", None) or ()]
            short = (alias.lstrip("-").replace("-", "_") for alias in aliases)
            known |= dict.fromkeys([".".join(setting.path), *short], setting.path)
    names: dict[tuple[str, ...], str] = {}
    method = config.method_name
    for name in settings:
        plain = name.replace("-", "_")
        path = known.get(plain)
        if path is None:
            same = [found for found, at in known.items() if at[-1] == plain]
            near = f"did you mean {min(same, key=len)}?" if same else did_you_mean(plain, known)
            listed = f"unmix-train {method} --help-all lists all"
            raise ConfigError(f"{method} has no setting {name}; {near or listed}")
        if path in names:
            raise ConfigError(f"{name} and {names[path]} are the same setting: give one of them")
        names[path] = name

    def given(setting: Setting) -> Setting:
        if setting.path not in names:
            return setting
        name = names[setting.path]
        value = settings[name]
        try:
            plain = config_to_json(value.item() if hasattr(value, "item") else value)
        except TypeError as error:
            raise ConfigError(f"{name}: {error}") from error
        read = value_from_json(plain, setting.hint, setting.value, ".".join(setting.path))
        return replace(setting, value=read)

    changed = map_settings(config, given)
    return with_limits_given(
        changed, steps=("max_num_iterations",) in names, seconds=("max_seconds",) in names
    )


def prepare(config: TrainerConfig, console: Console, processes: Processes | None = None) -> Trainer:
    """The trainer, with everything read and compiled that training needs."""
    from unmix_plugin.commands.reporting import announce_kernel_compilation, say, working
    from unmix_plugin.engine.processes import ALONE
    from unmix_plugin.engine.training.trainer import Trainer

    with nullcontext() if config.data is None else working(console, f"reading {config.data}"):
        trainer = Trainer(config, console=console, processes=processes or ALONE)
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
    if trainer.progress >= 1.0:
        limit = f"the run is at its limit, with {trainer.step} steps in {trainer.seconds:.1f} s"
        say(console, f"nothing to train: {limit}; give a larger --max-num-iterations or --max-seconds")
    return trainer


def finish(trainer: Trainer, console: Console) -> None:
    """Train to the end, write what the model has found, and say how it went.

    Raises:
        Interrupted: training was stopped on request.
    """
    from unmix_plugin.commands.reporting import say, spectral_scene
    from unmix_plugin.engine.training.training_control import Interrupted

    try:
        record = trainer.train()
    except Interrupted as stop:
        if stop.step == trainer.step:  # or files of an earlier training would stay beside what was saved
            _write_results(trainer)
        raise
    speed = f"{record.train_rays_per_second:,.0f} rays/s"
    say(console, f"trained {counted(record.steps, 'step')} in {record.train_seconds:.1f} s, {speed}")
    if record.skipped_steps:
        skipped = f"{counted(record.skipped_steps, 'step')} changed nothing"
        say(console, f"warning: {skipped}: loss or gradients were not finite, see {trainer.run.log_path}")
    _write_results(trainer)
    data = trainer.pipeline.datamanager
    scene = spectral_scene(data)
    if scene is not None:  # remarks name settings of spectral methods
        _judge_training_views(trainer, scene, console, record)
        num_pixels = int(data.metadata().get("num_train_pixels", 0))
        few = remark_on_passes(record.total_rays, num_pixels)
        for remark in [*remarks_on_course(trainer.run.metrics_path), *few]:
            say(console, remark)


def _judge_training_views(trainer: Trainer, scene: Scene, console: Console, done: TrainingRecord) -> None:
    """Say, here and in run.log, which training views do not fit the others, and what the materials do not explain;
    keep how far the scene is off."""
    from unmix_plugin.commands.reporting import say, working
    from unmix_plugin.engine.runs.loading import read_scene_record
    from unmix_plugin.engine.training.progress import write_event
    from unmix_plugin.settings import UnmixModelConfig
    from unmix_plugin.trained.measured_errors import measure_errors, write_errors
    from unmix_plugin.trained.open_run import mixture_scene
    from unmix_plugin.trained.places import MeasuredScene
    from unmix_plugin.trained.training_views import thinned_views
    from unmix_plugin.trained.unexplained import find_unexplained, write_unexplained
    from unmix_plugin.trained.view_fit import describe_misfits, fit_of_view, write_fits

    averages, run = None if trainer.average is None else trainer.average.values, trainer.run
    with trainer.control.device.training_turn(), working(console, "comparing training views"):
        record = read_scene_record(run)
        trained = mixture_scene(trainer.pipeline.model, trainer.config.method_name, record, averages)
        if trained is None:
            return
        measured = MeasuredScene(scene, record.summary.get("illuminant"))
        views = list(thinned_views(trained, measured))
        fits = [fit for fit in map(fit_of_view, views) if fit is not None]
        misfits = write_fits(run.path, fits)
        kept = [view for view in views if view.name not in misfits]
        unexplained = find_unexplained(trained, kept, done.total_rays)
        remarks = describe_misfits(misfits)
        if unexplained is not None:
            write_unexplained(run.path, unexplained, trained.materials)
            remarks += unexplained.in_words(run.path)
        settings = trainer.config.pipeline.model
        are_given = isinstance(settings, UnmixModelConfig) and settings.endmember_init == "file"
        write_errors(run.path, measure_errors(trained, views, are_given=are_given), done.steps)
    for remark in remarks:
        say(console, f"warning: {remark}")
        write_event(run, remark)


def _write_results(trainer: Trainer) -> None:
    averaged = nullcontext() if trainer.average is None else trainer.average.swapped_in()
    with trainer.control.device.training_turn(), averaged:
        trainer.pipeline.model.write_results(trainer.run.path)


_FEWEST_LINES = 8
"""Lines of metrics below which nothing is said."""
_OUTLIERS = 0.02
"""Share of poses that are not believed, of which more is said."""
_HARDLY_FELL = 0.6
"""Loss in the last quarter of the training, over that in the first, above which it hardly fell. Trainings that settle
stay below 0.35, also short ones."""
_STILL_FALLS = 0.3
"""Share by which the loss fell from the third to the last quarter, above which more steps are worthwhile."""

_LITTLE_FOREGROUND = 0.02
"""Part of light from anything but the sky below which a world has nothing else."""
_FEW_PASSES = 3
"""Rays for each training pixel below which fine detail is still being learnt."""


def remarks_on_course(metrics_path: Path) -> list[str]:
    """Sentences on a training's `metrics.jsonl`, whose `loss` is None where it was not finite."""
    from unmix_plugin.engine.training.progress import read_metrics

    lines = [line for line in read_metrics(metrics_path) if line.get("split") == "train"]
    known = [line for line in lines if line.get("loss") is not None]
    if len(known) < _FEWEST_LINES:
        return []
    first, third, last = (_typical_loss(known, quarter) for quarter in (1, 3, 4))
    if not first or not third or last is None:
        return []
    found = []
    undone = int(known[-1].get("poses_undone") or 0)
    if undone:
        found.append(
            f"corrections of the poses of {counted(undone, 'view')} went beyond a quarter of the distance to the scene "
            "or too far a turn and were undone: do these views belong to the scene? Else train with --poses fixed"
        )
    outliers = float(known[-1].get("pose_outliers") or 0)
    if outliers > _OUTLIERS:
        found.append(
            f"{outliers:.0%} of the views, or of the rows of line cameras, still fit far worse than the others and "
            "hardly shape the scene: their poses are off, or they show something else"
        )
    foreground = known[-1].get("matter_share")
    if foreground is not None and foreground < _LITTLE_FOREGROUND:
        found.append(
            f"{1 - foreground:.0%} of what the views show was learnt as sky: they agree on nothing nearer. If they "
            "show a scene, look whether poses belong to their pictures, or train with --world bounded"
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


def remark_on_passes(num_rays: int, num_pixels: int) -> list[str]:
    """A remark if the pixels of the training views (0: not known) were seen so rarely that more rays show more."""
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
