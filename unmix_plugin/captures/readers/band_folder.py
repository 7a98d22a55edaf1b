"""A folder that holds one file a band, as filter wheels and multi-lens cameras write it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.readers.wavelength_text import wavelengths_in_names
from unmix_plugin.captures.spectral_file import SpectralFile, stack_bands
from unmix_plugin.errors import CaptureError

_KINDS = {".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG", ".exr": "OpenEXR", ".jpg": "JPEG", ".jpeg": "JPEG"}


def open_band_folder(folder: Path, open_band: Callable[[Path], SpectralFile]) -> SpectralFile:
    """Open the files of a folder as the bands of one image, by rising wavelength or in the order of their names.

    Wavelengths are in the files, or in their names.

    Raises:
        CaptureError: there are no such files, or they hold several bands each or differ in size.
    """
    found = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    kinds = Counter(_KINDS[path.suffix.lower()] for path in found if path.suffix.lower() in _KINDS)
    if not kinds:
        raise CaptureError(f"{folder}: no band files in this folder; expected one {', '.join(_KINDS)} a band")
    kind, number = kinds.most_common(1)[0]
    files = sorted((path for path in found if _KINDS.get(path.suffix.lower()) == kind), key=_natural)
    bands = [open_band(path) for path in files]
    for band in bands:
        if band.shape[2] != 1:
            raise CaptureError(
                f"{band.path}: {band.shape[2]} bands; expected one band a file in {folder}, or one file with all"
            )
    if any(band.bands.wavelengths_nm is None for band in bands):
        bands = _with_wavelengths_of_names(bands)
    stack, others = stack_bands(_by_wavelength(bands), folder), kinds.total() - number
    noun = "picture of another kind" if others == 1 else "pictures of other kinds"
    notes = (f"{others} {noun} than {kind} in the folder left out",) if others else ()
    return replace(stack, interleave="bsq", notes=stack.notes + notes)


def _with_wavelengths_of_names(bands: list[SpectralFile]) -> list[SpectralFile]:
    stems = [band.path.stem for band in bands]
    found = wavelengths_in_names(stems)
    if found is None:
        return bands
    evidence = f"names of files, such as {bands[0].path.name!r}: {found.evidence}"
    return [
        replace(band, bands=replace(band.bands, wavelengths_nm=np.array([nm]), evidence=evidence))
        for band, nm in zip(bands, found.centres_nm.tolist(), strict=True)
    ]


def _by_wavelength(bands: list[SpectralFile]) -> list[SpectralFile]:
    known = [band.bands.wavelengths_nm for band in bands]
    centres = [nm[0] for nm in known if nm is not None]
    if len(centres) < len(bands):
        return bands
    return [bands[index] for index in np.argsort(centres, kind="stable")]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Numbers in names by their size: band_9 before band_10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() and len(part) < 19 else (-1, part) for part in parts]
