"""CSV files that come with a scene: the light's spectrum and the true endmembers, brought to the scene's bands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, read_illuminant_csv, read_spectra_csv


def read_illuminant(
    path: Path, wavelengths_nm: Float64[np.ndarray, " B"], where: str, faults: Faults
) -> Float64[np.ndarray, " B"] | None:
    """Relative power of the light, greatest value 1; None and a noted fault if it cannot be had at these bands."""
    try:
        return read_illuminant_csv(path, Bands(wavelengths_nm))
    except SpectrumError as error:
        faults.add(where, str(error))
        return None


def read_endmembers(
    path: Path,
    wavelengths_nm: Float64[np.ndarray, " B"],
    materials: tuple[str, ...] | None,
    where: str,
    faults: Faults,
) -> SpectraTable | None:
    """True endmembers in the order of `materials`, matched by name; None and a noted fault if they do not fit."""
    try:
        table = read_spectra_csv(path).resampled(Bands(wavelengths_nm))
    except SpectrumError as error:
        faults.add(where, str(error))
        return None
    if materials is None:
        return table
    if sorted(materials) != sorted(table.names):
        faults.add(where, f"{path} names {list(table.names)}; expected the 'materials' {list(materials)}")
        return None
    order = [table.names.index(name) for name in materials]
    return SpectraTable(table.bands, materials, table.spectra[order])
