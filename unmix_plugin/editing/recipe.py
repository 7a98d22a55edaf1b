"""A recipe: edits of materials in the order in which they are made, and optionally another light.

Each kind of edit is a dataclass, validated where it is made. An endmember is given by its name at that point of the
recipe, or by its number from 0. Colours are sRGB in [0, 1]. Fields are also the keys of a recipe's YAML, see
`recipe_files`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

from unmix_plugin.errors import ConfigError

Endmember: TypeAlias = str | int
"""Name, or number from 0."""

Colour: TypeAlias = tuple[float, float, float]
"""sRGB, [0, 1]."""

_Match: TypeAlias = Literal["picture", "spectrum"]
"""What is given a colour: the material as cameras see it, shaded, or its spectrum in full light."""

_LONGEST_NAME = 40
_GREATEST_FACTOR = 1000.0


@dataclass(frozen=True)
class Operation:
    """One edit; each kind is a class of its own."""

    kind: ClassVar[str]
    """Its name in a recipe."""
    is_list: ClassVar[bool] = False
    """Whether a recipe has its fields as a list, rather than by name."""
    needs_one_of: ClassVar[tuple[str, ...]] = ()
    """Fields of which a recipe must give at least one."""

    line: int | None = field(default=None, compare=False, kw_only=True)
    """In the recipe's file, from 1; None if it comes from no file."""


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
    match: _Match = "picture"

    def __post_init__(self) -> None:
        _require_colour(self.colour)
        if self.match not in ("picture", "spectrum"):
            raise ConfigError(f"match is picture or spectrum; found {self.match!r}")


@dataclass(frozen=True)
class Scale(Operation):
    """An endmember becomes brighter or darker."""

    kind = "scale"

    endmember: Endmember
    factor: float

    def __post_init__(self) -> None:
        _require_factor("factor", self.factor)


@dataclass(frozen=True)
class Remove(Operation):
    """Endmembers become transparent."""

    kind = "remove"
    is_list = True

    endmembers: tuple[Endmember, ...]

    def __post_init__(self) -> None:
        _require_some(self.endmembers)


@dataclass(frozen=True)
class Isolate(Operation):
    """All endmembers but these become transparent."""

    kind = "isolate"
    is_list = True

    endmembers: tuple[Endmember, ...]

    def __post_init__(self) -> None:
        _require_some(self.endmembers)


@dataclass(frozen=True)
class Rename(Operation):
    """An endmember gets another name, in all files and figures."""

    kind = "rename"

    endmember: Endmember
    name: str

    def __post_init__(self) -> None:
        """Names end up in CSV headers, ENVI lists, EXR channels and legends, so they are kept plain."""
        name = self.name
        is_plain = all(letter.isalnum() or letter in " _-" for letter in name)
        if not (name[:1].isalpha() and is_plain and name == name.strip() and len(name) <= _LONGEST_NAME):
            raise ConfigError(
                f"a name has at most {_LONGEST_NAME} letters, digits, spaces, - and _ and starts with a letter; "
                f"found {name!r}"
            )


@dataclass(frozen=True)
class Gloss(Operation):
    """The view-dependent part becomes stronger or weaker, and takes a colour."""

    kind = "gloss"
    needs_one_of = ("scale", "colour")

    endmember: Endmember | None = None
    """Whose gloss, by its share of each point; None for all."""
    scale: float = 1.0
    """0 makes matt."""
    colour: Colour | None = None
    """Highlights take it: white leaves them as they are, gold makes them golden."""

    def __post_init__(self) -> None:
        _require_factor("scale", self.scale)
        if self.colour is not None:
            _require_colour(self.colour)


OPERATIONS: tuple[type[Operation], ...] = (Swap, Replace, Retint, Scale, Remove, Isolate, Rename, Gloss)
"""Every kind of edit."""


def _require_colour(colour: Colour) -> None:
    if len(colour) != 3 or not all(math.isfinite(value) and 0 <= value <= 1 for value in colour):
        raise ConfigError(f"a colour is three sRGB values in [0, 1]; found {list(colour)}")


def _require_factor(name: str, factor: float) -> None:
    if not (math.isfinite(factor) and 0 <= factor <= _GREATEST_FACTOR):
        raise ConfigError(f"{name} must be a number from 0 to {_GREATEST_FACTOR:g}; found {factor!r}")


def _require_some(endmembers: tuple[Endmember, ...]) -> None:
    if not endmembers:
        raise ConfigError("no endmember is given; give at least one")


LightName: TypeAlias = str | Path
"""Name of a known light (`spectral.colour.conversion.illuminant_names`), or a CSV file, wavelength,power."""


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
        operation = self.operations[position]
        if operation.line is None:
            return f"{self.source}, edit {position + 1} ({operation.kind})"
        return f"{self.source}, line {operation.line} ({operation.kind})"

    @property
    def removes_parts(self) -> bool:
        """Whether anything becomes transparent."""
        return any(isinstance(one, Remove | Isolate) for one in self.operations)
