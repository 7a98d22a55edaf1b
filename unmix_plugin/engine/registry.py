"""Methods: what a package registers for one, what it can show, and finding ours and any third party's."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, TypeVar

from unmix_plugin.engine.configs import TrainerConfig, place_of
from unmix_plugin.errors import ConfigError, did_you_mean

METHOD_GROUP = "unmix_plugin.method_configs"
"""Entry-point group; each entry names a `MethodSpecification`."""


class MethodSpecification:
    """What a package registers for one method."""

    def __init__(
        self,
        config: TrainerConfig | Callable[[], TrainerConfig],
        description: str,
        scene: Callable[..., Any] | None = None,
        products: Callable[[], Sequence[Any]] | None = None,
        name: str | None = None,
    ) -> None:
        """
        Args:
            config: Defaults of everything, or what makes them when they are first asked for: settings may take seconds
                to import.
            description: One line for the list of methods.
            scene: From a model, the record of its scene and averaged parameters (None: the model's own) to what
                commands and the viewer show, as `trained.protocol.RenderableScene`; None: the model's `outputs`.
            products: What `unmix-export` can make of this method's runs and of no other's, as
                `products.product.RunProduct` with defaults; called when the command is. None: nothing of its own.
            name: On the command line, as `config.method_name`; needed where `config` is made later.
        """
        if name is None:
            config = config() if callable(config) else config
            name = config.method_name
        self._config, self.name = config, name
        self.description, self.scene, self.products = description, scene, products

    @cached_property
    def config(self) -> TrainerConfig:
        """Defaults of everything."""
        config = self._config() if callable(self._config) else self._config
        return replace(config, method_name=self.name)  # by which runs find their method


@dataclass(frozen=True)
class BrokenPlugin:
    """An entry point that could not be used."""

    name: str
    """The entry point's name."""
    reason: str
    """What went wrong, in one line."""

    def __str__(self) -> str:
        return f"skipped the plugin {self.name}: {self.reason}"


def discover_methods() -> tuple[dict[str, MethodSpecification], list[BrokenPlugin]]:
    """All methods installed, by name, and the plugins that had to be skipped."""
    methods: dict[str, MethodSpecification] = {}
    broken: list[BrokenPlugin] = []
    for entry_point in sorted(entry_points(group=METHOD_GROUP), key=lambda entry: (entry.name, entry.value)):
        found = _load(entry_point)
        if isinstance(found, MethodSpecification) and found.name in methods:
            found = BrokenPlugin(entry_point.name, f"a method {found.name} is registered already")
        if isinstance(found, BrokenPlugin):
            broken.append(found)
        else:
            methods[found.name] = found
    return methods, broken


def plugin_at_fault(error: BaseException) -> str | None:
    """Where an error left the code of somebody's plugin, as the plugin, file and line, or where a method of ours that a
    class of a plugin inherits calls it; None where none was running."""
    packages = {_package(entry.value) for entry in entry_points(group=METHOD_GROUP)} - {_package(__name__)}
    found = None
    for frame, line in traceback.walk_tb(error.__traceback__):
        package, kind = _package(frame.f_globals.get("__name__", "")), type(frame.f_locals.get("self"))
        if package in packages:
            found = f"{package} ({frame.f_code.co_filename}:{line}, in {frame.f_code.co_name})"
        elif found is None and _package(kind.__module__) in packages:
            found = f"{_package(kind.__module__)} ({place_of(kind)})"
    return found


def _package(name: object) -> str:
    """The package that a module, or what is called MODULE:NAME, is of."""
    return str(name).partition(":")[0].partition(".")[0]


def find_method(name: str) -> MethodSpecification:
    """The method called `name`.

    Raises:
        ConfigError: there is none; the message has the nearest names and why any plugin was skipped.
    """
    methods, broken = discover_methods()
    if name in methods:
        return methods[name]
    lines = [f"unknown method {name!r}{did_you_mean(name, methods, likeness=0.5, form='; {}')}"]
    lines.append(f"installed: {', '.join(sorted(methods)) or 'none'}")
    raise ConfigError("\n".join(lines + [str(plugin) for plugin in broken]))


def _load(entry_point: EntryPoint) -> MethodSpecification | BrokenPlugin:
    # A third party's module may fail in any way at all; one broken plugin must not take the others with it.
    try:
        found = entry_point.load()
    except Exception as error:  # noqa: BLE001
        lines = str(error).strip().splitlines() or ["no message"]
        return BrokenPlugin(entry_point.name, f"{type(error).__name__}: {lines[0]}")
    if not isinstance(found, MethodSpecification):
        return BrokenPlugin(
            entry_point.name, f"{entry_point.value} is a {type(found).__name__}, not a MethodSpecification"
        )
    return found


OutputKind = Literal[
    "channels", "spectra", "shares", "srgb", "linear", "picture", "grey", "map", "labels", "vectors"
]
"""What an output's numbers are, (height, width, ...): any channels, on black; a number a band of what is seen, NaN
where nothing is; a share or score of each class; sRGB on
black (3); linear light on black (3); a picture not multiplied by opacity (3); one channel of light on black; any other
number a pixel; uint8 ids, 255 where nothing is; unit vectors (3)."""


WORLD_UNITS, METRES = "world units", "metres"
"""Units of outputs that are lengths; maps in metres turn the one into the other."""


@dataclass(frozen=True)
class Output:
    """One thing that can be shown of a trained scene. What programs ask of it is a field; sentences are printed."""

    name: str
    """In commands, files and the viewer."""
    kind: OutputKind
    title: str
    """What a menu says."""
    label: str
    """What its numbers are, without their unit, as a colour bar says it."""
    value_range: tuple[float, float] | None = None
    """Values at the ends of a colour map; None where only the views tell."""
    colour_map: str = "viridis"
    """As matplotlib names it."""
    classes: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """Of labels and shares: names of the ids from 0, or of the channels, and their sRGB colours; empty where they have
    none of their own."""
    unit: str = field(default="", kw_only=True)
    """Of its numbers; `WORLD_UNITS` of lengths, which maps with a scale have in metres."""
    quantity: Literal["radiance", "reflectance"] | None = field(default=None, kw_only=True)
    """What spectra are, as OpenEXR and ENVI files say it."""
    centers_nm: tuple[float, ...] = field(default=(), kw_only=True)
    """Centre of the band that each channel is; empty where channels are not single bands, or those of the scene."""
    is_on_black: bool = field(default=False, kw_only=True)
    """Whether it is light seen before black, which pictures say otherwise."""
    is_premultiplied: bool = field(default=False, kw_only=True)
    """Whether its numbers are multiplied by the opacity, as light is anyway: pictures show them as of what is seen."""
    legend: str = field(default="", kw_only=True)
    """What the colours of pictures mean, for people; empty: what the numbers are."""
    nothing: int | None = field(default=None, kw_only=True)
    """The number of pixels in which nothing is, where only that tells them; means of other programs leave it out."""
    remarks: tuple[str, ...] = field(default=(), kw_only=True)
    """What else is to be known of the numbers, for people."""

    @property
    def label_with_unit(self) -> str:
        """What its numbers are."""
        return f"{self.label} in {self.unit}" if self.unit else self.label

    @property
    def what(self) -> str:
        """What its numbers are, in one line for people."""
        return self.described(" on black")

    def described(self, behind: str) -> str:
        """The same of a picture with something else behind than black."""
        return with_remarks(f"{self.label_with_unit}{behind if self.is_on_black else ''}", self.remarks)


def with_remarks(label: str, remarks: Sequence[str]) -> str:
    """A line for people.

    >>> with_remarks("radiance", ("1 = full scale", "false colour"))
    'radiance, 1 = full scale; false colour'
    """
    return "; ".join([", ".join([label, *remarks[:1]]), *remarks[1:]])


AnyOutput = TypeVar("AnyOutput", bound=Output)


def named_output(outputs: Iterable[AnyOutput], name: str) -> AnyOutput:
    """The output of that name.

    Raises:
        ConfigError: there is none.
    """
    named = {output.name: output for output in outputs}
    if name in named:
        return named[name]
    raise no_output(name, named, named)


def no_output(name: str, similar: Iterable[str], known: Collection[str]) -> ConfigError:
    """The error that there is no output of that name; an argument after a colon is not part of what is looked for.

    Args:
        similar: Names of which some may have been meant.
        known: What the message lists.
    """
    hint = did_you_mean(name.partition(":")[0], similar, likeness=0.5, form=" ({})")
    return ConfigError(f"there is no output named {name!r}{hint}; known are {', '.join(known)}")
