"""PNG and JPEG pictures: one band, or red, green and blue; and folders that hold one file a band.

Numbers are as they are stored: what is gamma-encoded stays so, and `metadata["encoding"]` says it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.captures.camera_tags import band_of, parse_xmp, radiometric_model
from unmix_plugin.captures.header_values import exif_exposure, wavelengths_in_names
from unmix_plugin.captures.names import natural_order
from unmix_plugin.captures.spectral_file import (
    COLOURS_AS_STORED,
    BandTable,
    ReadOptions,
    SpectralFile,
    import_extra,
    loaded,
    stack_bands,
)
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_decoded, allow_parts

_GREY = {"1": "u1", "L": "u1", "LA": "u1", "I;16": "u2", "I;16B": "u2", "I": "u2"}
_COLOUR = ("RGB", "RGBA", "P", "PA", "CMYK", "YCbCr")
_DEPTH_AT, _KIND_AT = 24, 25
"""Bits of a number, and kind of colours, in the first bytes of a PNG."""
_WITH_COLOURS = (2, 6)
_ORIENTATION = 0x0112
"""EXIF's code; 1 to 8, where 1 is not turned."""
_EXIF_DIRECTORY, _EXPOSURE_TIME, _ISO_SPEED, _F_NUMBER = 0x8769, 0x829A, 0x8827, 0x829D


def open_picture(path: Path, _: ReadOptions) -> SpectralFile:
    """Open a picture by its header; it is decoded when its first numbers are asked for. Raises CaptureError: it is
    damaged, or of a kind that has neither one band nor three."""
    from PIL import Image

    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        mode, (width, height), info = picture.mode, picture.size, dict(picture.info)
        num_bands = 1 if mode in _GREY else 3
        allow_decoded(path, width * height * num_bands, CaptureError)  # Exif of a PNG is read by decoding it
        exif = picture.getexif()
        orientation, taken = exif.get(_ORIENTATION, 1), exif.get_ifd(_EXIF_DIRECTORY)
    with path.open("rb") as file:
        begin = file.read(_KIND_AT + 1)
    # Pillow would cut the colours of a PNG of 16 bits to 8.
    is_deep = begin[:4] == b"\x89PNG" and begin[_DEPTH_AT] == 16 and begin[_KIND_AT] in _WITH_COLOURS
    if mode not in _GREY and mode not in _COLOUR:
        raise CaptureError(f"{path}: a picture of mode {mode}; expected grey or RGB")
    dtype = np.dtype("u2") if is_deep else np.dtype(_GREY.get(mode, "u1"))
    allow_decoded(path, width * height * num_bands * dtype.itemsize, CaptureError)
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
    metadata |= exif_exposure(*(taken.get(tag) for tag in (_EXPOSURE_TIME, _ISO_SPEED, _F_NUMBER)))
    if alpha:
        metadata["has_alpha"] = True
    return SpectralFile(
        path=path,
        reader="picture",
        shape=(height, width, num_bands),
        dtype=dtype,
        read_part=lambda rows, wanted: loaded(_load, path, is_deep)[rows][..., wanted],
        bands=bands,
        interleave="bip" if num_bands == 3 else None,
        notes=("the picture has opacity, which is not a band and is left out",) if alpha else (),
        warnings=(COLOURS_AS_STORED,) if is_deep and bands.wavelengths_nm is None else (),
        metadata=metadata,
    )


def _load(path: Path, is_deep: bool) -> np.ndarray:
    """Numbers (H, W, 1 or 3), neither turned nor linearised."""
    from PIL import Image

    if is_deep:
        return import_extra("imagecodecs").png_decode(path.read_bytes())[..., :3]
    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        if picture.mode in _GREY:
            grey = picture.convert("L") if picture.mode in ("1", "LA") else picture
            return np.asarray(grey).astype(_GREY[picture.mode])[..., None]
        return np.asarray(picture.convert("RGB"))


_KINDS = {".tif": "TIFF", ".tiff": "TIFF", ".png": "PNG", ".exr": "OpenEXR", ".jpg": "JPEG", ".jpeg": "JPEG"}


def open_band_folder(folder: Path, open_band: Callable[[Path], SpectralFile]) -> SpectralFile:
    """Open the files of a folder as the bands of one image, by rising wavelength or in the order of their names.

    Wavelengths are in the files, or in their names. Raises CaptureError: there are no such files, they hold several
    bands each or differ in size, or a lens of a rig took each.
    """
    found = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    kinds = Counter(_KINDS[path.suffix.lower()] for path in found if path.suffix.lower() in _KINDS)
    if not kinds:
        raise CaptureError(f"{folder}: no band files in this folder; expected one {', '.join(_KINDS)} a band")
    kind, number = kinds.most_common(1)[0]
    allow_parts(folder, number, "band files", CaptureError)
    files = sorted(
        (path for path in found if _KINDS.get(path.suffix.lower()) == kind),
        key=lambda path: natural_order(path.name),
    )
    bands = [open_band(path) for path in files]
    for band in bands:
        if band.shape[2] != 1:
            raise CaptureError(f"{band.path}: {band.shape[2]} bands; expected one band a file in {folder}")
        if (model := radiometric_model(band)) is not None:
            raise CaptureError(
                f"{band.path}: of one lens of a {model.maker} camera, with a calibration of its own, and bands of "
                "several lenses do not lie on each other; read the folder with the layout rig"
            )
    named = wavelengths_in_names([band.path.stem for band in bands])
    if named is not None and any(band.bands.wavelengths_nm is None for band in bands):
        evidence = f"names of files, such as {bands[0].path.name!r}: {named[1]}"
        centres = named[0][:, None]
        widths = [band.bands.fwhm_nm for band in bands] if named[2] is None else named[2][:, None]
        tables = [
            replace(band.bands, wavelengths_nm=nm, evidence=evidence, fwhm_nm=fwhm)
            for band, nm, fwhm in zip(bands, centres, widths, strict=True)
        ]
        bands = [replace(band, bands=table) for band, table in zip(bands, tables, strict=True)]
    centres = [band.bands.wavelengths_nm[0] for band in bands if band.bands.wavelengths_nm is not None]
    if len(centres) == len(bands):
        bands = [bands[index] for index in np.argsort(centres, kind="stable")]
    stack, others = stack_bands(bands, folder), kinds.total() - number
    noun = "picture of another kind" if others == 1 else "pictures of other kinds"
    notes = (f"{others} {noun} than {kind} in the folder left out",) if others else ()
    return replace(stack, interleave="bsq", notes=stack.notes + notes)
