"""A recipe: changes of materials in the order in which they are made, and perhaps another light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from unmix_plugin.editing.operations import Isolate, Operation, Remove, Retint


@dataclass(frozen=True)
class Light:
    """What a scene is lit by."""

    light: str | Path
    """Name of a known light (`spectral.illuminants.illuminant_names`), or a CSV file, wavelength,power."""
    extrapolate: bool = False
    """Hold the outermost values where the light is not known at the run's bands."""


@dataclass(frozen=True)
class Recipe:
    """Edits of a run as plain data; says nothing of any particular run."""

    operations: tuple[Operation, ...] = ()
    """In the order in which they are made."""
    illuminant: Light | None = None
    """Light to see the result in; None leaves the scene's own."""
    source: str = field(default="recipe", compare=False)
    """What error messages call it: the file's path."""

    def where(self, position: int) -> str:
        """How an error message points at the operation at `position`."""
        operation = self.operations[position]
        if operation.line is None:
            return f"{self.source}, edit {position + 1} ({operation.kind})"
        return f"{self.source}, line {operation.line} ({operation.kind})"

    @property
    def wants_pictures(self) -> bool:
        """Whether the result depends on how cameras see the materials, see `apply.edit_model`."""
        return any(isinstance(one, Retint) and one.match == "picture" for one in self.operations)

    @property
    def removes_matter(self) -> bool:
        """Whether anything becomes transparent."""
        return any(isinstance(one, Remove | Isolate) for one in self.operations)
