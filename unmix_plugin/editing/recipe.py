"""A recipe: edits of materials in the order in which they are made, and optionally another light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from unmix_plugin.editing.operations import Isolate, Operation, Remove, Retint

LightName: TypeAlias = str | Path
"""Name of a known light (`spectral.colour.illuminants.illuminant_names`), or a CSV file, wavelength,power."""


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
    def wants_pictures(self) -> bool:
        """Whether the result depends on how cameras see the materials."""
        return any(isinstance(one, Retint) and one.match == "picture" for one in self.operations)

    @property
    def removes_parts(self) -> bool:
        """Whether anything becomes transparent."""
        return any(isinstance(one, Remove | Isolate) for one in self.operations)
