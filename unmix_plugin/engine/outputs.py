"""What can be shown of a trained scene: one row an output, of any method."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from unmix_plugin.errors import ConfigError, did_you_mean

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
