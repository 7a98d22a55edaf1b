"""PNG and JPEG pictures: one band, or red, green and blue.

Numbers are as they are stored: what is gamma-encoded stays so, and `Cube.is_srgb` says it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from unmix_plugin.captures.camera_tags import parse_xmp, with_camera_tags
from unmix_plugin.captures.cube import (
    BandTable,
    CameraTags,
    Cube,
    ReadOptions,
    import_extra,
)
from unmix_plugin.captures.fields import state_exposure
from unmix_plugin.captures.numbers import Decoded, Numbers
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError
from unmix_plugin.limits import allow_decoded

_GREY = {"1": "u1", "L": "u1", "LA": "u1", "I;16": "u2", "I;16B": "u2", "I": "u2"}
_COLOUR = ("RGB", "RGBA", "P", "PA", "CMYK", "YCbCr")
_DEEP_BANDS = {b"\x10\2": 3, b"\x10\4": 1, b"\x10\6": 3}
"""Bands of PNG that Pillow would cut to 8 bits, by bits of a number (16) and kind of colours (4 is grey with opacity),
which lie in its first bytes."""
_DEPTH_AND_KIND = slice(24, 26)
_ORIENTATION = 0x0112
"""EXIF's code; 1 to 8, where 1 is not turned."""
_EXIF_DIRECTORY = 0x8769
_EXPOSURE = {0x829A: "EXIF ExposureTime", 0x8827: "EXIF ISOSpeedRatings", 0x829D: "EXIF FNumber"}


def open_picture(path: Path, _: ReadOptions) -> Cube:
    """Open a picture by its header; it is decoded when its first numbers are asked for. Raises CaptureError: it is
    damaged, or of a kind that has neither one band nor three."""
    from PIL import Image

    with path.open("rb") as file:
        begin = file.read(_DEPTH_AND_KIND.stop)
    deep = _DEEP_BANDS.get(begin[_DEPTH_AND_KIND], 0) if begin[:4] == b"\x89PNG" else 0
    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        mode, (width, height), info = picture.mode, picture.size, dict(picture.info)
        num_bands = deep or (1 if mode in _GREY else 3)
        allow_decoded(path, width * height * num_bands, CaptureError)  # Exif of a PNG is read by decoding it
        exif = picture.getexif()
        orientation, taken = exif.get(_ORIENTATION, 1), exif.get_ifd(_EXIF_DIRECTORY)
    if mode not in _GREY and mode not in _COLOUR:
        raise CaptureError(f"{path}: a picture of mode {mode}; expected grey or RGB")
    dtype = np.dtype("u2") if deep else np.dtype(_GREY.get(mode, "u1"))
    allow_decoded(path, width * height * num_bands * dtype.itemsize, CaptureError)
    alpha = mode in ("RGBA", "LA", "PA") or "transparency" in info
    xmp = parse_xmp(info.get("xmp") or b"")
    colours = BandTable(names=("red", "green", "blue") if num_bands == 3 else None)
    bands = with_camera_tags(colours, xmp, num_bands)
    remarks = [Remark.of(Code.COLOURS_AS_STORED)] if deep == 3 and bands.wavelengths_nm is None else []
    remarks += [Remark.of(Code.OPACITY_LEFT_OUT)] if alpha else []
    exposed = {name: taken[code] for code, name in _EXPOSURE.items() if code in taken}
    exposure = state_exposure(exposed, "tag", remarks)
    size = height, width, num_bands
    return Cube(
        path=path,
        reader="picture",
        shape=size,
        dtype=dtype,
        numbers=Numbers((Decoded(path, dtype, size, _decode, (deep,)),), size, "yxb", dtype),
        bands=bands,
        interleave="bip" if num_bands == 3 else None,
        remarks=tuple(remarks),
        exposure=exposure,
        camera=CameraTags(xmp),
        is_srgb=num_bands == 3 and dtype.itemsize == 1 and bands.wavelengths_nm is None,
        orientation=orientation if orientation in range(1, 9) else 1,
        others={"has_alpha": True} if alpha else {},
    )


def _decode(path: Path, numbers: np.ndarray, deep: int) -> None:
    """Numbers (H, W, 1 or 3), neither turned nor linearised; of a PNG of 16 bits so many bands."""
    from PIL import Image

    if deep:
        numbers[:] = (
            import_extra("imagecodecs").png_decode(path.read_bytes())[..., :deep].reshape(numbers.shape)
        )
        return
    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        if picture.mode in _GREY:
            grey = picture.convert("L") if picture.mode in ("1", "LA") else picture
            numbers[..., 0] = np.asarray(grey).astype(_GREY[picture.mode])
        else:
            numbers[:] = np.asarray(picture.convert("RGB"))
