"""What a trained model can show: outputs by name, each of a kind that says how to write and draw it."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal, TypeVar

from unmix_plugin.errors import ConfigError, did_you_mean

OutputKind = Literal["channels", "shares", "srgb", "linear", "picture", "grey", "map", "labels", "vectors"]
"""What an output's numbers are, (height, width, ...): any channels, on black; a share or score of each class; sRGB on
black (3); linear light on black (3); a picture not multiplied by opacity (3); one channel of light on black; any other
number a pixel; uint8 ids, 255 where nothing is; unit vectors (3)."""


@dataclass(frozen=True)
class Output:
    """One thing that can be shown of a trained scene."""

    name: str
    """In commands, files and the viewer."""
    kind: OutputKind
    title: str
    """What a menu says."""
    what: str
    """What its numbers are, with their unit."""
    value_range: tuple[float, float] | None = None
    """Values at the ends of a colour map; None where only the views tell."""
    colour_map: str = "viridis"
    """As matplotlib names it."""


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
