"""PNG pictures: colours with opacity, and ids with a palette.

Notation: `H x W` pixels, `N` colours.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

if TYPE_CHECKING:
    from PIL.Image import Image


def rgba_png_bytes(rgba: UInt8[np.ndarray, "H W C"], description: str = "") -> bytes:
    """sRGB colours, three or four channels; the fourth is opacity, by which colours are not multiplied.

    `description` says what is shown; it is written into the file as its `Description`.
    """
    from PIL import Image

    return _encoded(Image.fromarray(rgba), description)


def indexed_png_bytes(
    ids: UInt8[np.ndarray, "H W"],
    palette: Float[np.ndarray, "N 3"],
    transparent: int | None = None,
    description: str = "",
) -> bytes:
    """Ids whose colours are in the palette: readers get either, as they ask.

    Args:
        ids: Indices.
        palette: sRGB in [0, 1], at most 256.
        transparent: An id that is not painted.
        description: As `rgba_png_bytes` takes it.
    """
    from PIL import Image

    picture = Image.fromarray(ids, mode=None).copy()
    picture.putpalette(np.round(np.asarray(palette) * 255).astype(np.uint8).tobytes())
    return _encoded(picture, description, transparent)


def _encoded(picture: Image, description: str, transparent: int | None = None) -> bytes:
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    if description:
        text.add_itxt("Description", description)
    buffer = io.BytesIO()
    options = {} if transparent is None else {"transparency": transparent}
    picture.save(buffer, format="PNG", pnginfo=text, **options)
    return buffer.getvalue()
