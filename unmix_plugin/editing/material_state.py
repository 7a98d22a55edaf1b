"""Materials while a recipe changes them, and what has been done to which of them, so that no edit undoes another.

Notation: `B` bands, `K` endmembers, `J` specular spectra.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float64

from unmix_plugin.editing.operations import Colour, Endmember
from unmix_plugin.errors import ConfigError, did_you_mean
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import Coefficients, Materials


@dataclass
class MaterialState:
    """What edits act on; they change it in place."""

    bands: Bands
    light: Float64[np.ndarray, " B"]
    """Of the scene, relative power; flat where it is unknown."""
    names: list[str]
    spectra: Float64[np.ndarray, "K B"]
    """Radiance in the scene's light."""
    specular_spectra: Float64[np.ndarray, "J B"]
    is_kept: Bool[np.ndarray, " K"]
    """False for what is transparent."""
    gloss: Float64[np.ndarray, " K"]
    """Factor on the view-dependent part, by the share that an endmember has of a point."""
    mirrors: list[Colour | None]
    """sRGB colour that the highlights of each endmember are mirrored in."""
    mirror_reflectances: dict[Colour | None, Float64[np.ndarray, " B"]]
    """The surface that each of these colours stands for."""
    seen: Coefficients | None
    """What cameras see, rows of pixels (N, ...); None where that is not known."""
    done: dict[tuple[str, int], str] = field(default_factory=dict)
    """Which edit did what to which endmember."""
    notes: list[str] = field(default_factory=list)
    """What the user has to be told about the result."""

    @classmethod
    def of(
        cls, materials: Materials, light: Float64[np.ndarray, " B"] | None, seen: Coefficients | None
    ) -> MaterialState:
        """The materials of a model as they are, in a light (None: unknown)."""
        spectra = materials.endmembers.detach().to("cpu", torch.float64).numpy().copy()
        count = len(spectra)
        return cls(
            materials.bands,
            np.ones(len(materials.bands)) if light is None else light,
            list(materials.names),
            spectra,
            materials.specular_spectra.detach().to("cpu", torch.float64).numpy().copy(),
            np.ones(count, dtype=bool),
            np.ones(count),
            [None] * count,
            {None: np.ones(len(materials.bands))},
            seen,
        )

    def index_of(self, endmember: Endmember) -> int:
        """The number of an endmember.

        Raises:
            ConfigError: there is none of that name or number; the message has the nearest names.
        """
        if isinstance(endmember, int):
            if 0 <= endmember < len(self.names):
                return endmember
            raise ConfigError(f"there is no endmember {endmember}; the run has {self._listed()}")
        if endmember in self.names:
            return self.names.index(endmember)
        hint = did_you_mean(endmember, self.names, form="{} ")
        raise ConfigError(f"there is no endmember {endmember!r}; {hint}the run has {self._listed()}")

    def note(self, what: str, index: int, edit: str) -> None:
        """Remember that an edit did something to an endmember, which may be done once.

        Args:
            what: Was done, as in "replaced".
            index: Of the endmember.
            edit: Which edit did it, for messages.
        Raises:
            ConfigError: another edit did the same.
        """
        before = self.done.get((what, index))
        if before is not None:
            raise ConfigError(f"{self.names[index]!r} is {what} already by {before}; keep one of the two")
        self.done[what, index] = edit

    def swap_notes(self, whats: tuple[str, ...], first: int, second: int) -> None:
        """Let what was done to two endmembers' looks go with the looks."""
        for what in whats:
            at_first, at_second = self.done.pop((what, first), None), self.done.pop((what, second), None)
            self.done |= {(what, second): at_first} if at_first else {}
            self.done |= {(what, first): at_second} if at_second else {}

    def _listed(self) -> str:
        return ", ".join(f"{index} {name}" for index, name in enumerate(self.names))
