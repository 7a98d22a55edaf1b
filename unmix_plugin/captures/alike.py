"""Views of one sensor are alike: same size, same bands, same type of numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from unmix_plugin.captures.capture import CaptureView
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

LARGEST_DIFFERENCE_NM = 0.1


def refuse_unlike_views(views: Sequence[CaptureView]) -> None:
    """Refuse views that differ from the first of their sensor.

    Raises:
        CaptureError: they do.
    """
    first: dict[str, SpectralFile] = {}
    for view in views:
        _refuse_unlike(view.cube, first.setdefault(view.sensor, view.cube))


def _refuse_unlike(cube: SpectralFile, first: SpectralFile) -> None:
    if cube.shape != first.shape:
        found, expected = (" x ".join(map(str, file.shape)) for file in (cube, first))
        raise CaptureError(
            f"{cube.path} has {found} rows, columns and bands; expected {expected}, as {first.path} has: all views of "
            "a camera are alike, so crop or remove this one"
        )
    wavelengths, expected_nm = cube.bands.wavelengths_nm, first.bands.wavelengths_nm
    if (wavelengths is None) != (expected_nm is None):
        raise CaptureError(
            f"only one of {cube.path} and {first.path} gives wavelengths; give them for all with --wavelengths"
        )
    if wavelengths is not None and expected_nm is not None:
        band = int(np.argmax(np.abs(wavelengths - expected_nm)))
        if abs(wavelengths[band] - expected_nm[band]) > LARGEST_DIFFERENCE_NM:
            raise CaptureError(
                f"{cube.path} has {wavelengths[band]:g} nm at band {band}; expected {expected_nm[band]:g} nm, as "
                f"{first.path} has: all views of a camera have the same bands"
            )
    if cube.dtype != first.dtype:
        raise CaptureError(
            f"{cube.path} holds {cube.dtype.name}; expected {first.dtype.name}, as {first.path} holds: convert all "
            "views alike"
        )
