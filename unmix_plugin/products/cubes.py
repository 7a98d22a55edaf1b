"""Spectral images of views, in formats of remote sensing and of rendering."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from unmix_plugin.formats.envi import write_envi_cube
from unmix_plugin.formats.exr import write_spectral_exr
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.products.abundances import view_paths
from unmix_plugin.products.product import ViewProduct
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import PredictedView


@dataclass(frozen=True)
class Cubes(ViewProduct):
    """Spectral images: of each view radiance on black, (H, W, bands) float32, 1 = full scale, as ENVI (VIEW.hdr and
    VIEW.img), spectral OpenEXR (VIEW.exr) or VIEW.npy."""

    name = "cubes"

    formats: tuple[Literal["envi", "exr", "npy"], ...] = ("envi",)
    """envi, exr, npy (without wavelengths)."""

    def paths(self, folder: Path, view: str) -> list[Path]:
        """Files of a view."""
        return [path for kind in self.formats for path in view_paths(folder, view, kind)]

    def write_view(
        self, folder: Path, view: str, rendered: PredictedView, materials: Materials
    ) -> list[Path]:
        """Write the spectra of a view."""
        spectra, bands = rendered.spectra.numpy().astype(np.float32), materials.bands
        about = f"{view}: radiance on black, 1 = full scale"
        for kind in self.formats:
            path = folder / f"{view}.{kind}"
            if kind == "npy":
                write_file(path, array_bytes(spectra))
            elif kind == "envi":
                names = [f"{wavelength:g} nm" for wavelength in bands.centers_nm]
                write_envi_cube(folder / view, spectra, bands, names, about)
            else:
                preview = (rendered.spectra.float().clamp(0, 1) @ rgb_matrix(bands)).clamp(0, 1).numpy()
                write_spectral_exr(path, spectra, bands, preview, rendered.coverage.float().numpy(), about)
        return self.paths(folder, view)
