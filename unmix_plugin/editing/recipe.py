"""A recipe: edits of materials in the order in which they are made, and optionally another light.

Each kind of edit is a dataclass, validated where it is made. An endmember is given by its name at that point of the
recipe, or by its number from 0. Colours are sRGB in [0, 1]. Fields are also the keys of a recipe's YAML, see
`recipe_files`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

from unmix_plugin.errors import ConfigError

Endmember: TypeAlias = str | int
"""Name, or number from 0."""

Colour: TypeAlias = tuple[float, float, float]
"""sRGB, [0, 1]."""

_LONGEST_NAME = 40
_GREATEST_FACTOR = 1000.0


def _fault(name: str, value: Any) -> str | None:
    """What is wrong with the value of a field, whichever edit has it; None if nothing."""
    if name == "colour" and not (len(value) == 3 and all(0 <= part <= 1 for part in value)):
        return f"a colour is three sRGB values in [0, 1]; found {list(value)}"
    if name in ("factor", "scale") and not (math.isfinite(value) and 0 <= value <= _GREATEST_FACTOR):
        return f"{name} must be a number from 0 to {_GREATEST_FACTOR:g}; found {value!r}"
    if name == "endmembers" and not value:
        return "no endmember is given; give at least one"
    if name == "match" and value not in ("picture", "spectrum"):
        return f"match must be picture or spectrum; found {value!r}"
    if name == "name":
        # Names end up in CSV headers, ENVI lists, EXR channels and legends, so they are kept plain.
        is_plain = all(letter.isalnum() or letter in " _-" for letter in value)
        if not (value[:1].isalpha() and is_plain and value == value.strip() and len(value) <= _LONGEST_NAME):
            return (
                f"a name has at most {_LONGEST_NAME} letters, digits, spaces, - and _ and starts with a letter; "
                f"found {value!r}"
            )
    return None


@dataclass(frozen=True)
class Operation:
    """One edit; each kind is a class of its own."""

    kind: ClassVar[str]
    """Its name in a recipe."""
    is_list: ClassVar[bool] = False
    """Whether a recipe has its fields as a list, rather than by name."""

    line: int | None = field(default=None, compare=False, kw_only=True)
    """In the recipe's file, from 1; None if it comes from no file."""

    def __post_init__(self) -> None:
        for own in fields(self):
            value = getattr(self, own.name)
            if value is None and own.default is not None:
                raise ConfigError(f"{own.name} of an edit is missing; found None")
            if value is not None and (fault := _fault(own.name, value)):
                raise ConfigError(fault)


@dataclass(frozen=True)
class Swap(Operation):
    """Two endmembers exchange their spectra: each stays where it is and looks like the other."""

    kind = "swap"
    is_list = True
    first: Endmember
    second: Endmember


@dataclass(frozen=True)
class Replace(Operation):
    """An endmember becomes another material: that one's reflectance in the scene's light."""

    kind = "replace"
    endmember: Endmember
    library: str | None = None
    """A measured reflectance that comes with the program: its name in full, or its last part if that is unique."""
    file: Path | None = None
    """One of a file of the user's: a library of any kind that `--library` takes."""
    spectrum: str | None = None
    """Which spectrum of the file; None if it has only one."""
    extrapolate: bool = False
    """Hold the outermost values in bands that the measured reflectance does not reach."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.library is None) == (self.file is None):
            raise ConfigError("give either library or file")
        if self.library is not None and self.spectrum is not None:
            raise ConfigError("spectrum goes with file, not with library")


@dataclass(frozen=True)
class Retint(Operation):
    """An endmember's spectrum changes smoothly until it has a colour in the scene's light."""

    kind = "retint"
    endmember: Endmember
    colour: Colour
    match: str = "picture"
    """What is given the colour: `picture`, the material as cameras see it, shaded, or its `spectrum` in full light."""


@dataclass(frozen=True)
class Scale(Operation):
    """An endmember becomes brighter or darker."""

    kind = "scale"
    endmember: Endmember
    factor: float


@dataclass(frozen=True)
class Remove(Operation):
    """Endmembers become transparent."""

    kind = "remove"
    is_list = True
    endmembers: tuple[Endmember, ...]


@dataclass(frozen=True)
class Isolate(Operation):
    """All endmembers but these become transparent."""

    kind = "isolate"
    is_list = True
    endmembers: tuple[Endmember, ...]


@dataclass(frozen=True)
class Rename(Operation):
    """An endmember gets another name, in all files and figures."""

    kind = "rename"
    endmember: Endmember
    name: str


@dataclass(frozen=True)
class Gloss(Operation):
    """The view-dependent part becomes stronger or weaker, and takes a colour."""

    kind = "gloss"
    endmember: Endmember | None = None
    """Whose gloss, by its share of each point; None for all."""
    scale: float = 1.0
    """0 makes matt."""
    colour: Colour | None = None
    """Highlights take it: white leaves them as they are, gold makes them golden."""


OPERATIONS: tuple[type[Operation], ...] = (Swap, Replace, Retint, Scale, Remove, Isolate, Rename, Gloss)
"""Every kind of edit."""

LightName: TypeAlias = str | Path
"""Name of a known light (`spectral.colour.conversion.illuminant_names`), or a CSV file, wavelength,power."""


COMMON_LIGHTS = {
    "D65": "noon daylight, 6504 K",
    "D50": "warmer daylight, 5003 K, as for prints",
    "A": "incandescent lamp, 2856 K",
    "E": "equal energy at all wavelengths",
    "C": "daylight, 6774 K, as taken before D65",
    "FL2": "cool white fluorescent lamp, 4230 K",
    "FL7": "daylight fluorescent lamp, 6500 K",
    "FL11": "narrow-band fluorescent lamp, 4000 K",
    "LED-B3": "white LED, 4103 K",
}
"""Names of usual lights, and what they are in words. Source: CIE 15:2018."""


def light_title(name: str) -> str:
    """A light as menus call it.

    >>> light_title("A"), light_title("lamp")
    ('A: incandescent lamp, 2856 K', 'lamp')
    """
    return f"{name}: {COMMON_LIGHTS[name]}" if name in COMMON_LIGHTS else name


@dataclass(frozen=True)
class Light:
    """What a scene is lit by."""

    light: LightName
    extrapolate: bool = False
    """Hold the outermost values in bands that the light's table does not reach, rather than leave them dark."""


@dataclass(frozen=True)
class Recipe:
    """Edits as plain data, for any run."""

    operations: tuple[Operation, ...] = ()
    """Made in this order."""
    illuminant: Light | None = None
    """Light to see the result in; None leaves the scene's own."""
    source: str = field(default="recipe", compare=False)
    """Its name in error messages: the file's path."""

    def where(self, position: int) -> str:
        """The place of an operation, for error messages."""
        one = self.operations[position]
        place = f"edit {position + 1}" if one.line is None else f"line {one.line}"
        return f"{self.source}, {place} ({one.kind})"
