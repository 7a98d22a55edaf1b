"""Frozen settings that know which class they are for.

A config is a frozen dataclass of plain values (numbers, strings, paths, tuples, further configs) beside the class
that it configures. The string under each field is its help on the command line.
"""

from dataclasses import dataclass, field
from typing import Any

import tyro

from unmix_plugin.errors import ConfigError

Target = tyro.conf.Suppress[type]
"""Annotation of `_target`: the class that a config sets up; neither shown on the command line nor written to a file."""

Common = "common"
"""Annotation of a setting that most people need: `Annotated[int, Common, short("name")]`; --help shows only these."""


def short(name: str) -> Any:
    """Annotation that gives a setting the flag `--name` beside its long one."""
    return tyro.conf.arg(aliases=(f"--{name}",))


@dataclass(frozen=True)
class InstantiateConfig:
    """Settings of one object, and the class that takes them."""

    _target: Target = field(default_factory=lambda: object)
    """Class that `setup` calls. Subclasses write `_target: Target = field(default_factory=lambda: TheirClass)`."""

    def setup(self, **kwargs: Any) -> Any:
        """The configured object: `_target(self, **kwargs)`."""
        return self._target(self, **kwargs)


def require_in_range(name: str, value: int | float, low: int | float, high: int | float) -> None:
    """Refuse a setting outside [low, high].

    Raises:
        ConfigError: it is outside, or not a number.
    """
    if not low <= value <= high:
        raise ConfigError(f"{name} must be from {low} to {high}; got {value}")
