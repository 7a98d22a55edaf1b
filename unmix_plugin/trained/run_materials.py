"""The materials of a trained scene: their spectra, names and colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.figures.plotting import distinct_colours, own_colours
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import Materials


def endmember_colours(materials: Materials) -> Float64[np.ndarray, "K 3"]:
    """sRGB colours that stand for the endmembers in all pictures of a run: near their own, and told apart."""
    return distinct_colours(own_colours(materials.endmembers, materials.bands))


def endmember_table(materials: Materials) -> SpectraTable:
    """The endmembers with names: spectra under the scene's light, [0, 1]."""
    spectra = materials.endmembers.detach().to("cpu", torch.float64).numpy()
    return SpectraTable(materials.bands, materials.names, spectra)


def write_endmembers_csv(path: Path, materials: Materials) -> Path:
    """Write `wavelength` and a column for each endmember under its name, one row a band.

    Raises:
        RunError: the disk is full or refuses.
    """
    write_spectra_csv(path, endmember_table(materials))
    return path
