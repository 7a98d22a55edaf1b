"""Spectral images of views, in formats of remote sensing and of rendering.

Notation: `H x W` pixels, `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unmix_plugin.formats.envi_cube import envi_cube_paths, write_envi_cube
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.formats.spectral_exr import write_spectral_exr
from unmix_plugin.products.product_formats import CubeFormat
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.trained.view_rendering import RenderedView

_WHAT = "radiance on black, 1 = full scale"


def cube_paths(folder: Path, name: str, formats: Sequence[CubeFormat]) -> list[Path]:
    """Files that `write_cube` makes for a view."""
    return [path for kind in formats for path in _paths(folder / name, kind)]


def write_cube(
    folder: Path, name: str, view: RenderedView, bands: Bands, formats: Sequence[CubeFormat]
) -> list[Path]:
    """Write the spectra of a view, (H, W, B) float32, with their wavelengths; `npy` has none.

    Raises:
        RunError: the disk is full or refuses.
    """
    written: list[Path] = []
    spectra = view.spectra.numpy().astype(np.float32)
    for kind in formats:
        path = _paths(folder / name, kind)[0]
        if kind == "npy":
            written.append(write_file(path, array_bytes(spectra)))
        elif kind == "envi":
            names = [f"{wavelength:g} nm" for wavelength in bands.centers_nm]
            written += write_envi_cube(path.with_suffix(""), spectra, bands, names, f"{name}: {_WHAT}")
        else:
            preview = (view.spectra.float().clamp(0, 1) @ rgb_matrix(bands)).clamp(0, 1).numpy()
            opacity = view.accumulation.float().numpy()
            written.append(write_spectral_exr(path, spectra, bands, preview, opacity, f"{name}: {_WHAT}"))
    return written


def _paths(base: Path, kind: CubeFormat) -> list[Path]:
    return envi_cube_paths(base) if kind == "envi" else [base.with_name(f"{base.name}.{kind}")]
