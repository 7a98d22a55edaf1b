"""Methods: what a package registers for one, and finding ours and any third party's."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Protocol

from unmix_plugin.engine.configs import TrainerConfig, place_of
from unmix_plugin.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from torch import Tensor

    from unmix_plugin.engine.model import Model
    from unmix_plugin.engine.outputs import Output
    from unmix_plugin.engine.runs.scene_record import SceneRecord

METHOD_GROUP = "unmix_plugin.method_configs"
"""Entry-point group; each entry names a `MethodSpecification`."""


class ShownScene(Protocol):
    """What the engine knows of a trained scene: `trained.protocol.RenderableScene` is all of it."""

    @property
    def outputs(self) -> tuple[Output, ...]:
        """All outputs that take no argument."""
        ...


SceneMaker = Callable[["Model", "SceneRecord", "Mapping[str, Tensor] | None"], ShownScene]
"""From a model, the record of its scene and averaged parameters (None: the model's own) to its trained scene."""


class MethodSpecification:
    """What a package registers for one method."""

    def __init__(
        self,
        config: TrainerConfig | Callable[[], TrainerConfig],
        description: str,
        scene: SceneMaker | None = None,
        products: Callable[[], Sequence[Any]] | None = None,
        name: str | None = None,
        complete: Callable[[TrainerConfig], TrainerConfig] | None = None,
    ) -> None:
        """
        Args:
            config: Defaults of everything, or what makes them when they are first asked for: settings may take seconds
                to import.
            description: One line for the list of methods.
            scene: Makes what commands and the viewer show, a `trained.protocol.RenderableScene`; None: the model's
                `outputs`.
            products: What `unmix-export` can make of this method's runs and of no other's, as
                `products.product.RunProduct` with defaults; called when the command is. None: nothing of its own.
            name: On the command line, as `config.method_name`; needed where `config` is made later.
            complete: Given the settings of a new training before anything is read, makes what else it needs, such as
                its data from those of another run, and gives the settings with that; None: they are as they are.
        """
        if name is None:
            config = config() if callable(config) else config
            name = config.method_name
        self._config, self.name = config, name
        self.description, self.scene, self.products = description, scene, products
        self.complete = complete

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
        try:
            found = entry_point.load()
        except Exception as error:  # noqa: BLE001 - a third party's module may fail in any way at all
            lines = str(error).strip().splitlines() or ["no message"]
            broken.append(BrokenPlugin(entry_point.name, f"{type(error).__name__}: {lines[0]}"))
            continue
        if not isinstance(found, MethodSpecification):
            reason = f"{entry_point.value} is a {type(found).__name__}, not a MethodSpecification"
            broken.append(BrokenPlugin(entry_point.name, reason))
        elif found.name in methods:
            broken.append(BrokenPlugin(entry_point.name, f"a method {found.name} is registered already"))
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
