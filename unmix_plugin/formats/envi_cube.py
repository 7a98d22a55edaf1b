"""ENVI images: NAME.hdr, a text, and NAME.img, the numbers, band-interleaved by pixel.

Notation: `H x W` pixels, `C` bands.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from unmix_plugin.formats.envi_header import (
    HeaderValue,
    beside,
    envi_rows,
    layout_entries,
    wavelength_entries,
)
from unmix_plugin.formats.raw_rows import RowSink
from unmix_plugin.spectral.bands import Bands

_SHOWN_NM = (640.0, 550.0, 460.0)
"""Red, green and blue that a viewer shows first, as far as there are bands for them."""


def envi_cube_paths(path_without_suffix: Path) -> list[Path]:
    """Files that `write_envi_cube` makes."""
    return [beside(path_without_suffix, ".hdr"), beside(path_without_suffix, ".img")]


def write_envi_cube(
    path_without_suffix: Path,
    cube: Float32[np.ndarray, "H W C"],
    wavelengths: Bands | None,
    names: Sequence[str] | None,
    description: str,
) -> list[Path]:
    """Write a cube as NAME.hdr and NAME.img, float32.

    Args:
        path_without_suffix: Folder, which is made, and NAME.
        cube: Any numbers.
        wavelengths: Centres of the bands, if they are bands of a spectrum.
        names: Of the bands; commas in them become `-`, as the format has no other way.
        description: What the numbers are, with their unit.
    Raises:
        ValueError: another number of wavelengths or names than of bands.
    """
    with envi_cube_rows(path_without_suffix, cube.shape, wavelengths, names, description) as add:
        add(cube)
    return envi_cube_paths(path_without_suffix)


@contextmanager
def envi_cube_rows(
    path_without_suffix: Path,
    shape: tuple[int, int, int],
    wavelengths: Bands | None,
    names: Sequence[str] | None,
    description: str,
) -> Iterator[RowSink]:
    """Context that gives a sink for the rows of a cube of `shape` (H, W, C); the rest is as in `write_envi_cube`."""
    for what, given in (("wavelengths", wavelengths), ("names", names)):
        if given is not None and len(given) != shape[2]:
            raise ValueError(f"{len(given)} {what} for {shape[2]} bands")
    height, width, num_bands = shape
    entries: dict[str, HeaderValue] = {
        "description": description,
        "file type": "ENVI Standard",
        **layout_entries(width, height, num_bands, "bip"),
    }
    if wavelengths is not None:
        entries |= wavelength_entries(wavelengths)
    if names is not None:
        entries["band names"] = list(names)
    if wavelengths is not None and all(map(wavelengths.contains, _SHOWN_NM)):
        entries["default bands"] = [str(wavelengths.nearest(wavelength) + 1) for wavelength in _SHOWN_NM]
    with envi_rows(envi_cube_paths(path_without_suffix), shape, entries) as add:
        yield add
