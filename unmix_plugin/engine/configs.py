"""Settings of a training: frozen, plain values, and which class each part is for.

A config is a frozen dataclass of plain values (numbers, strings, paths, tuples, further configs); `config.json` and the
command line spell out the same tree. The string under each field is its help. Nothing here imports what it configures,
so that the help of a command is quick.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import tyro

from unmix_plugin.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    import torch

Target = tyro.conf.Suppress[type | str]
"""Annotation of `_target`: the class that a config sets up, or where it is, "package.module:Class", which is imported
when it is needed. Neither shown on the command line nor written to a file."""

CommonFlag = "common"
"""Annotation of a setting that most people need: `Annotated[int, CommonFlag, short_flag("name")]`; --help shows only
these."""

UnlistedFlag = "hidden"
"""Annotation of a setting that works as a flag, but that no help lists: `Annotated[int, UnlistedFlag]`."""

AtStartOnly = "at start"
"""Annotation of a setting that acts when a run is started, never again: going on with it refuses another value."""


def short_flag(name: str) -> Any:
    """Annotation that gives a setting the flag `--name` beside its long one."""
    return tyro.conf.arg(aliases=(f"--{name}",))


@dataclass(frozen=True)
class Check:
    """One rule that settings must keep."""

    fields: str | tuple[str, ...]
    """The field that it bounds; or all that it is about, whose values a message tells."""
    rule: str
    """What follows the field's name, such as "of at least 1"; of several fields the whole rule, named as flags are."""
    holds: bool

    def broken(self, settings: Any) -> str:
        """The rule in words, and what was found."""
        names = (self.fields,) if isinstance(self.fields, str) else self.fields
        values = {name.replace("_", "-"): getattr(settings, name) for name in names}
        shown = [f"{name} {'none' if value is None else value}" for name, value in values.items()]
        if len(shown) == 1:
            shown = [text.partition(" ")[2] for text in shown]
        rule = f"{next(iter(values))} {self.rule}" if isinstance(self.fields, str) else self.rule
        return f"{rule} (got {', '.join(shown)})" if shown else rule


@dataclass(frozen=True)
class Within:
    """Annotation of a number that must lie in an interval, as in `Annotated[float | Auto, Within("(0, 1]")]`; words
    such as `auto`, and None, may stand in its place."""

    interval: str
    """Its ends; a round bracket beside an end that is left out. No number is infinite."""

    def holds(self, value: Any) -> bool:
        """Whether a value of that type keeps it."""
        if value is None or isinstance(value, str):
            return True
        low, high = map(float, self.interval[1:-1].split(","))
        above = low < value if self.interval[0] == "(" else low <= value
        return above and (value < high if self.interval[-1] == ")" else value <= high)

    def rule(self, hint: Any) -> str:
        """The interval in words, and what else a setting of this type may be."""
        (first, low, high, last), kinds = re.findall(r"[\[(\])]|[^\[(\]), ]+", self.interval), get_args(hint)
        words = f"of {low} to {high}" if first + last == "[]" else f"in {self.interval}"
        if high == "inf":
            words = f"above {low}" if first == "(" else f"of at least {low}"
            words += " and finite" if float in (hint, *kinds) else ""
        choices = [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]
        return " or ".join([words, *choices])


@cache
def type_hints(kind: type) -> dict[str, Any]:
    """Types of a config's fields with their annotations."""
    return get_type_hints(kind, include_extras=True)


@cache
def _intervals(kind: type) -> dict[str, tuple[Within, str]]:
    """By name: the fields of a config that must lie in an interval, and the rule in words; a class that gives a field
    another default keeps it."""
    found = {}
    for base in reversed(kind.__mro__):
        for name, hint in type_hints(base).items():
            for mark in getattr(hint, "__metadata__", ()):
                if isinstance(mark, Within):
                    found[name] = mark, mark.rule(get_args(hint)[0])
    return found


@dataclass(frozen=True)
class Settings:
    """Base of all configs, which are checked when they are made."""

    _called: ClassVar[str] = "a part of the settings"
    """In messages."""

    def __post_init__(self) -> None:
        """Refuse numbers that are not `Within` their intervals, and broken `rules`, all by one `ConfigError`."""
        checks = [
            Check(name, rule, interval.holds(getattr(self, name)))
            for name, (interval, rule) in _intervals(type(self)).items()
        ]
        if broken := [check.broken(self) for check in (*checks, *self.rules()) if not check.holds]:
            raise ConfigError(f"{self._called} needs {' and '.join(broken)}")

    def rules(self) -> Iterator[Check]:
        """What else must hold; a subclass adds to those of its base."""
        yield from ()


@dataclass(frozen=True)
class InstantiateConfig(Settings):
    """Settings of one object, and the class that takes them."""

    _target: Target = object
    """Class that `setup` calls. Subclasses write `_target: Target = field(default_factory=lambda: TheirClass)`, or
    `_target: Target = "package.module:TheirClass"`."""

    @property
    def target(self) -> Any:
        """The class that `setup` calls, imported."""
        if not isinstance(self._target, str):
            return self._target
        module, _, name = self._target.partition(":")
        return getattr(import_module(module), name)

    def setup(self, **kwargs: Any) -> Any:
        """The configured object: `target(self, **kwargs)`. Raises ConfigError: the class lacks methods that it must
        have."""
        target = self.target
        if missing := sorted(getattr(target, "__abstractmethods__", ())):
            raise ConfigError(
                f"{place_of(target)} has no {' and no '.join(missing)}: a method must write them itself"
            )
        return target(self, **kwargs)


def place_of(kind: type) -> str:
    """A class, and where it is written, for messages about what it does."""
    try:
        place = f" ({inspect.getsourcefile(kind)}:{inspect.getsourcelines(kind)[1]})"
    except (OSError, TypeError):  # made by a program
        place = ""
    return f"{kind.__module__}.{kind.__qualname__}{place}"


MOST_PROCESSES = 1024
"""That train one model together."""

DeviceName = Literal["auto", "cpu", "cuda"]
"""`auto` is CUDA where there is one."""


@dataclass(frozen=True)
class OptimizerConfig(Settings):
    """Adam for one group of parameters, and its learning-rate schedule."""

    _called = "an optimizer"
    lr: Annotated[float, Within("(0, inf)")] = 1e-2
    """Step size at the start of training."""
    final_factor: Annotated[float, Within("(0, 1]")] = 0.1
    """Step size at the end of training as a part of `lr`; between, it falls by equal factors. 1 keeps it constant."""
    weight_decay: Annotated[float, Within("[0, inf)")] = 0.0
    """Times the parameters, added to their gradient: draws what the data leaves open to 0."""


@dataclass(frozen=True)
class DataManagerConfig(InstantiateConfig):
    """Settings that every data manager has."""

    _target: Target = "unmix_plugin.engine.model:DataManager"
    _called = "the data manager"
    train_num_rays_per_batch: Annotated[int, Within("[1, 4194304]")] = 4096
    """Rays of the first training step; a model may adapt the number later."""


@dataclass(frozen=True)
class ModelConfig(InstantiateConfig):
    """Settings that every model has."""

    _target: Target = "unmix_plugin.engine.model:Model"
    _called = "the model"
    eval_num_rays_per_chunk: Annotated[int | Literal["auto"], Within("[256, 4194304]")] = "auto"
    """Rays rendered at once for a whole image; fewer take less memory. Auto is 32,768 on a CPU, 131,072 on a GPU."""

    def resolve_auto(
        self, initial_data: Callable[[], Mapping[str, np.ndarray]], generator: torch.Generator
    ) -> tuple[ModelConfig, str]:
        """These settings with every `auto` replaced by a value, and the reasons in words.

        Called for new runs and for loaded ones, which have no `auto` left: call `initial_data`, which takes seconds,
        only to decide something. `generator` is on the CPU.
        """
        return self, ""


@dataclass(frozen=True)
class PipelineConfig(InstantiateConfig):
    """Settings of the data and of the model."""

    _target: Target = "unmix_plugin.engine.pipeline:Pipeline"
    datamanager: DataManagerConfig = field(default_factory=DataManagerConfig)
    """How the scene is read and sampled."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """What is trained."""


@dataclass(frozen=True)
class MachineConfig(Settings):
    """On what to train."""

    _called = "a machine"
    num_devices: Annotated[int, Within(f"[1, {MOST_PROCESSES}]")] = 1
    """Processes that share the rays of each step, on CUDA each on a device of its own, on the CPU each with a part of
    the cores. Several machines: start them with torchrun, which says how many there are."""


@dataclass(frozen=True)
class TrainerConfig(Settings):
    """Settings of one training run; `Trainer(config)` runs it."""

    _called = "a training"
    method_name: tyro.conf.Suppress[str] = "unnamed"
    """Name under which the method is registered."""
    data: Annotated[Path | None, CommonFlag] = None
    """The scene's folder."""
    output_dir: Annotated[Path, CommonFlag, AtStartOnly] = Path("outputs")
    """Folder under which the run's own folder is made."""
    max_num_iterations: Annotated[int | None, CommonFlag, Within("[0, inf)")] = 20_000
    """Training ends after so many steps (None: no such limit)."""
    max_seconds: Annotated[float | None, CommonFlag, Within("(0, inf)")] = None
    """Training ends after so many seconds of training; reading, compiling, evaluating and saving not counted."""
    seed: Annotated[int, CommonFlag] = 42
    """Everything random follows from this."""
    device: Annotated[DeviceName, CommonFlag] = "auto"
    """Where to compute; auto takes CUDA where there is one."""
    steps_per_save: Annotated[int, Within("[0, inf)")] = 1000
    """Save a checkpoint every so many steps; 0: only at the end."""
    steps_per_eval_all_images: Annotated[int, Within("[0, inf)")] = 0
    """Evaluate all evaluation views every so many steps; 0: never."""
    steps_per_log: Annotated[int, Within("[1, inf)")] = 50
    """Write losses and metrics to metrics.jsonl every so many steps."""
    checkpoints_kept: Annotated[int, Within("[1, inf)")] = 2
    """How many of the newest checkpoints stay in the run folder."""
    average_decay: Annotated[tyro.conf.Suppress[float | None], Within("[0, 1)")] = None
    """Decay a step of the moving average of the parameters with which the run is evaluated and rendered; early in
    training it decays faster, to span at most about a ninth of the steps so far. None: no average."""
    load_run: Annotated[Path | None, CommonFlag] = None
    """Run folder to continue instead of starting a new one."""
    machine: MachineConfig = MachineConfig()
    """Devices and processes."""
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    """Data and model."""
    optimizers: tyro.conf.Suppress[Mapping[str, OptimizerConfig]] = field(default_factory=dict)
    """Settings of the optimiser by parameter group."""

    def rules(self) -> Iterator[Check]:
        """A limit, a seed that torch takes, and a name that a folder can have."""
        yield Check(
            ("max_num_iterations", "max_seconds"),
            "max-num-iterations or max-seconds",
            (self.max_num_iterations, self.max_seconds) != (None, None),
        )
        yield Check("seed", "of -2^63 to 2^63 - 1", -(2**63) <= self.seed < 2**63)
        yield Check(
            ("method_name",),
            "a file name as method-name",
            bool(self.method_name) and "/" not in self.method_name,
        )

    def progress(self, steps: int, seconds: float) -> float:
        """Fraction in [0, 1] that so many steps and seconds of training are of the limit that is nearer its end."""
        limits = ((steps, self.max_num_iterations), (seconds, self.max_seconds))
        parts = [spent / limit if limit else 1.0 for spent, limit in limits if limit is not None]
        return min(1.0, max(parts))


@dataclass(frozen=True)
class Setting:
    """One setting in a tree of configs."""

    path: tuple[str, ...]
    """Names of the fields that lead to it."""
    value: Any
    hint: Any
    """Type of its field, with annotations such as `AtStartOnly` and `short_flag`."""

    @property
    def marks(self) -> tuple[Any, ...]:
        """The annotations."""
        return getattr(self.hint, "__metadata__", ())

    @property
    def flag(self) -> str:
        """What it is called on the command line."""
        return "--" + ".".join(self.path).replace("_", "-")


def settings_of(config: Any, path: tuple[str, ...] = ()) -> Iterator[Setting]:
    """All settings in a tree of configs, in their order; not those that begin with `_`, which say what is set up."""
    hints = type_hints(type(config))
    for entry in fields(config):
        value, here = getattr(config, entry.name), (*path, entry.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from settings_of(value, here)
        elif not entry.name.startswith("_"):
            yield Setting(here, value, hints[entry.name])


def map_settings(config: Any, change: Callable[[Setting], Setting], path: tuple[str, ...] = ()) -> Any:
    """The same tree of configs with each setting as `change` makes it.

    A config whose annotations change becomes one of a subclass that has these, for the help of a command.
    """
    values: dict[str, Any] = {}
    hints = type_hints(type(config))
    changed_hints: dict[str, Any] = {}
    for entry in fields(config):
        value, here, hint = getattr(config, entry.name), (*path, entry.name), hints[entry.name]
        if is_dataclass(value) and not isinstance(value, type):
            values[entry.name] = map_settings(value, change, here)
            changed_hint = hint if type(values[entry.name]) is type(value) else type(values[entry.name])
        elif entry.name.startswith("_"):
            continue
        else:
            setting = change(Setting(here, value, hint))
            values[entry.name], changed_hint = setting.value, setting.hint
        if changed_hint is not hint:
            changed_hints[entry.name] = changed_hint
    changed = replace(config, **values)
    if not changed_hints:
        return changed
    own = [
        (name, hint, field(default_factory=lambda value=values[name]: value))
        for name, hint in changed_hints.items()
    ]
    kind = make_dataclass(type(config).__name__, own, bases=(type(config),), frozen=True)
    return kind(**{entry.name: getattr(changed, entry.name) for entry in fields(changed)})


def refuse_changes_at_start(before: Any, now: Any) -> None:
    """Compare the settings of a run with those to go on with. Raises ConfigError: one differs that is annotated with
    `AtStartOnly`, and would be written down without having acted."""
    old = {setting.path: setting.value for setting in settings_of(before)}
    for setting in settings_of(now):
        if AtStartOnly in setting.marks and old.get(setting.path) != setting.value:
            raise ConfigError(
                f"{setting.flag} is {setting.value}, and the run to go on with was started with "
                f"{old.get(setting.path)}: it acts when a run is started alone; leave it out, or start a new run"
            )
