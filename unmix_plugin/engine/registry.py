"""Finding methods: ours and any third party's, through entry points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.errors import ConfigError, did_you_mean

METHOD_GROUP = "unmix_plugin.method_configs"
"""Entry-point group; each entry names a `MethodSpecification`."""


@dataclass(frozen=True)
class MethodSpecification:
    """What a package registers for one method."""

    config: TrainerConfig
    """Defaults of everything; `config.method_name` is the method's name on the command line."""
    description: str
    """One line for the list of methods."""
    scene: Callable[..., Any] | None = None
    """From a model, the record of its scene and averaged parameters (None: the model's own) to what commands and the
    viewer show, as `trained.protocol.RenderableScene`; None: the model's `outputs`."""
    products: Callable[[], Sequence[Any]] | None = None
    """What `unmix-export` can make of this method's runs and of no other's, as `products.product.RunProduct` with
    defaults; called when the command is. None: nothing of its own."""


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
        if isinstance(found, MethodSpecification) and found.config.method_name in methods:
            found = BrokenPlugin(
                entry_point.name, f"a method {found.config.method_name} is registered already"
            )
        if isinstance(found, BrokenPlugin):
            broken.append(found)
        else:
            methods[found.config.method_name] = found
    return methods, broken


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
