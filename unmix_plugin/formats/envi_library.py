"""ENVI spectral libraries: NAME.hdr, a text, and NAME.sli, one spectrum after the other.

Notation: `K` spectra, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unmix_plugin.formats.envi_header import beside, envi_rows, layout_entries, wavelength_entries
from unmix_plugin.spectral.bands import Bands


def envi_library_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_envi_library` makes."""
    return [beside(path_without_suffix, ".hdr"), beside(path_without_suffix, ".sli")]


def write_envi_library(
    path_without_suffix: Path,
    spectra: Float[np.ndarray, "K B"],
    bands: Bands,
    names: Sequence[str],
    description: str = "spectra",
) -> list[Path]:
    """Write spectra as NAME.hdr and NAME.sli, float32; commas in names become `-`, as the format has no other way.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        spectra, bands, names: Any numbers, their wavelengths, and what each spectrum is called.
        description: What the numbers are, with their unit.
    Raises:
        ValueError: another number of names than of spectra, or of wavelengths than of bands.
    """
    if spectra.shape != (len(names), len(bands)):
        raise ValueError(f"{len(names)} names and {len(bands)} wavelengths for spectra of {spectra.shape}")
    entries = {
        "description": description,
        "file type": "ENVI Spectral Library",
        **layout_entries(len(bands), len(names), 1, "bsq"),
        **wavelength_entries(bands),
        "spectra names": list(names),
    }
    paths = envi_library_paths(path_without_suffix)
    with envi_rows(paths, spectra.shape, entries) as add:
        add(spectra)
    return paths
