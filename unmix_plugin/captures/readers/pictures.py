"""PNG and JPEG pictures: one band, or red, green and blue, as they are stored.

What is gamma-encoded stays so; `metadata["encoding"]` says it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import band_of, parse_xmp
from unmix_plugin.captures.readers.extras import import_extra
from unmix_plugin.captures.readers.loaded_arrays import loaded
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import BandTable, SpectralFile
from unmix_plugin.errors import CaptureError

_GREY = {"1": "u1", "L": "u1", "LA": "u1", "I;16": "u2", "I;16B": "u2", "I": "u2"}
_COLOUR = ("RGB", "RGBA", "P", "PA", "CMYK", "YCbCr")
_DEPTH_AT, _KIND_AT = 24, 25
"""Bits of a number, and kind of colours, in the first bytes of a PNG."""
_WITH_COLOURS = (2, 6)
_ORIENTATION = 0x0112
"""EXIF's code; 1 to 8, where 1 is not turned."""


def open_picture(path: Path, _: ReadOptions) -> SpectralFile:
    """Open a picture by its header; it is decoded when its first numbers are asked for.

    Raises:
        CaptureError: it is damaged, or of a kind that has neither one band nor three.
    """
    from PIL import Image

    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        mode, (width, height), info = picture.mode, picture.size, dict(picture.info)
        orientation = picture.getexif().get(_ORIENTATION, 1)
    is_deep = _is_deep_colour(path)
    if mode not in _GREY and mode not in _COLOUR:
        raise CaptureError(f"{path}: a picture of mode {mode}; expected grey or RGB")
    num_bands = 1 if mode in _GREY else 3
    dtype = np.dtype("u2") if is_deep else np.dtype(_GREY.get(mode, "u1"))
    alpha = mode in ("RGBA", "LA", "PA") or "transparency" in info
    xmp = parse_xmp(info.get("xmp") or b"")
    bands = band_of(xmp)
    if bands is None or bands.wavelengths_nm is None or len(bands.wavelengths_nm) != num_bands:
        bands = BandTable(names=("red", "green", "blue") if num_bands == 3 else None)
    metadata: dict[str, Any] = {"xmp": xmp} if xmp else {}
    if num_bands == 3 and dtype.itemsize == 1 and bands.wavelengths_nm is None:
        metadata["encoding"] = "sRGB"
    if orientation in range(2, 9):
        metadata["orientation"] = orientation
    if alpha:
        metadata["has_alpha"] = True
    return SpectralFile(
        path=path,
        reader="picture",
        shape=(height, width, num_bands),
        dtype=dtype,
        read_part=lambda rows, wanted: loaded(_load_deep if is_deep else _load, path)[rows][..., wanted],
        bands=bands,
        interleave="bip" if num_bands == 3 else None,
        notes=("the picture has opacity, which is not a band and is left out",) if alpha else (),
        metadata=metadata,
    )


def _is_deep_colour(path: Path) -> bool:
    """Whether it is a PNG with colours of 16 bits, which Pillow would cut to 8."""
    with path.open("rb") as file:
        begin = file.read(_KIND_AT + 1)
    return begin[:4] == b"\x89PNG" and begin[_DEPTH_AT] == 16 and begin[_KIND_AT] in _WITH_COLOURS


def _load(path: Path) -> np.ndarray:
    """Numbers (H, W, 1 or 3), neither turned nor linearised."""
    from PIL import Image

    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        if picture.mode in _GREY:
            grey = picture.convert("L") if picture.mode in ("1", "LA") else picture
            return np.asarray(grey).astype(_GREY[picture.mode])[..., None]
        return np.asarray(picture.convert("RGB"))


def _load_deep(path: Path) -> np.ndarray:
    return import_extra("imagecodecs").png_decode(path.read_bytes())[..., :3]
