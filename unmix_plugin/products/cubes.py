"""Spectral images of views, in formats of remote sensing and of rendering."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from unmix_plugin.formats.envi import write_envi_cube
from unmix_plugin.formats.exr import write_spectral_exr
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.products.abundances import view_paths
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Cubes
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import PredictedView


def export(job: Job, asked: Cubes) -> list[Path]:
    """Write the spectra of views."""
    return job.write_views(
        asked.views, partial(view_paths, asked.formats), partial(_write_view, asked.formats)
    )


def _write_view(
    formats: Sequence[str], folder: Path, view: str, rendered: PredictedView, materials: Materials
) -> None:
    spectra, bands = rendered.spectra.numpy().astype(np.float32), materials.bands
    about = f"{view}: {materials.quantity} on black, 1 = full scale"
    for kind in formats:
        path = folder / f"{view}.{kind}"
        if kind == "npy":
            write_file(path, array_bytes(spectra))
        elif kind == "envi":
            names = [f"{wavelength:g} nm" for wavelength in bands.centers_nm]
            write_envi_cube(folder / view, spectra, bands, names, about)
        else:
            preview = (rendered.spectra.float().clamp(0, 1) @ rgb_matrix(bands)).clamp(0, 1).numpy()
            alpha = rendered.coverage.float().numpy()
            write_spectral_exr(path, spectra, bands, preview, alpha, about, materials.quantity)
