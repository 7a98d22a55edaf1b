"""Known materials that the spectra of a scene resemble."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from unmix_plugin.spectral.library.material_library import LibraryMatch, measured_library
from unmix_plugin.spectral.materials import Materials

_ALIKE_RAD = 0.1
"""Spectral angle up to which two materials are alike."""


def nearest_materials(
    spectra: Float[np.ndarray, "N B"], materials: Materials, count: int = 3
) -> list[list[LibraryMatch]]:
    """Known materials that spectra resemble, seen in the light of `materials`."""
    light = None if materials.light is None else materials.light.cpu().double().numpy()
    return measured_library().nearest(spectra, materials.bands, light, count)


def likeness_rows(spectrum: Float[np.ndarray, "B"], materials: Materials) -> list[tuple[str, str]]:
    """Rows of a table of the known materials that a spectrum resembles."""
    matches = nearest_materials(spectrum[None], materials)[0]
    return [("like" if rank == 0 else "", likeness(match)) for rank, match in enumerate(matches)]


def likeness(match: LibraryMatch) -> str:
    """A known material and its spectral angle; matches that say little are marked."""
    remark = "" if match.angle_rad <= _ALIKE_RAD else ", not alike"
    return f"{match.name} ({match.angle_rad:.3f} rad{remark})"
