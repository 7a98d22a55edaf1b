"""The materials of a trained scene: their spectra, names and colours, and which known materials they resemble.

Radiance is divided by the light it was seen in, if that is known, before it is compared.

Notation: `N` spectra, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from unmix_plugin.figures.plotting import distinct_colours, own_colours
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.material_library import (
    DARK_LIGHT,
    Comparison,
    LibraryMatch,
    MaterialLibrary,
)
from unmix_plugin.spectral.materials import Materials


def endmember_colours(materials: Materials) -> Float64[np.ndarray, "K 3"]:
    """sRGB colours that stand for the endmembers in all pictures of a run: near their own, and told apart."""
    own = own_colours(materials.endmembers, materials.bands)
    return np.frombuffer(_distinct(own.tobytes())).reshape(own.shape).copy()


@lru_cache(maxsize=64)
def _distinct(own: bytes) -> bytes:
    """Colours told apart: what the viewer asks at each picture takes a while to find."""
    return distinct_colours(np.frombuffer(own).reshape(-1, 3)).tobytes()


LIGHT_UNKNOWN = (
    "the light of the scene is unknown and taken as flat: matches are of radiance rather than of reflectance"
)
"""What has to be said of matches where the scene's light is unknown."""


def relit(
    measured: Float[np.ndarray, "*pixels B"],
    recorded: Sequence[float] | None,
    light: Float64[np.ndarray, " B"] | None,
) -> Float64[np.ndarray, "*pixels B"]:
    """Radiance measured in a recorded light (relative power; None: flat) as it is in another (None: the same); 0 in
    bands that the first left dark."""
    if light is None:
        return measured.astype(np.float64)
    before = np.ones(len(light)) if recorded is None else np.asarray(recorded, dtype=np.float64)
    lit = before > DARK_LIGHT * before.max()
    return measured * np.divide(light, before, out=np.zeros_like(light), where=lit)


@dataclass(frozen=True)
class ShownMatch:
    """A known material beside the spectrum that it resembles."""

    match: LibraryMatch
    spectrum: Float64[np.ndarray, " B"]
    """The material in the light of the scene, as bright as the spectrum (least squares); NaN where it is unknown."""


def shown_matches(
    spectra: Float[np.ndarray, "N B"],
    bands: Bands,
    light: Float64[np.ndarray, " B"] | None,
    library: MaterialLibrary,
    comparison: Comparison = "scale",
) -> list[list[ShownMatch]]:
    """The three nearest materials of each spectrum, nearest first, in the light and brightness of the spectrum."""
    found = library.nearest(spectra, bands, light, 3, comparison)
    known = dict(
        zip(library.names, library.resampled(bands) * (1.0 if light is None else light), strict=True)
    )
    shown: list[list[ShownMatch]] = []
    for spectrum, matches in zip(spectra, found, strict=True):
        shown.append([])
        for match in matches:
            lit = known[match.name]
            shared = np.isfinite(lit)
            power = float(lit[shared] @ lit[shared])
            gain = float(lit[shared] @ spectrum[shared]) / power if power > 0 else 0.0
            shown[-1].append(ShownMatch(match, lit * gain))
    return shown


def match_json(match: LibraryMatch) -> dict[str, Any]:
    """A match as JSON has it."""
    given = {"name": match.name, "angle_rad": match.angle_rad}
    return {**given, "bands_compared": match.num_bands, "source": match.source}
