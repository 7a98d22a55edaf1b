"""ENVI spectral libraries: NAME.hdr, a text, and NAME.sli, one spectrum after the other.

Notation: `K` spectra, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from unmix_plugin.atomic_files import write_errors_as
from unmix_plugin.formats.envi_header import beside, header_bytes, layout_entries, wavelength_entries
from unmix_plugin.formats.files import write_file
from unmix_plugin.formats.raw_rows import raw_rows
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
    """Write spectra as NAME.hdr and NAME.sli, float32.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        spectra: Any numbers.
        bands: Their wavelengths.
        names: Of the spectra; commas in them become `-`, as the format has no other way.
        description: What the numbers are, with their unit.
    Returns:
        The files.
    Raises:
        RunError: the disk is full or refuses.
        ValueError: another number of names than of spectra, or of wavelengths than of bands.
    """
    if spectra.shape != (len(names), len(bands)):
        raise ValueError(
            f"{len(names)} names and {len(bands)} wavelengths for spectra of shape {spectra.shape}"
        )
    header_path, data_path = envi_library_paths(path_without_suffix)
    kind = np.dtype("<f4")
    entries = {
        "description": description,
        "file type": "ENVI Spectral Library",
        **layout_entries(len(bands), len(names), 1, kind, "bsq"),
        **wavelength_entries(bands),
        "spectra names": list(names),
    }
    with raw_rows(data_path, b"", spectra.shape, kind) as add:
        add(spectra)
        with write_errors_as(header_path):
            header_path.unlink(missing_ok=True)
    write_file(header_path, header_bytes(entries))
    return [header_path, data_path]
