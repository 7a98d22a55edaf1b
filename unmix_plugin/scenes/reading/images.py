"""Reading the PNG, JPEG or TIFF pictures of a scene: colour with alpha, labels, masks.

Pictures whose size isn't the one expected are refused by their header: a few hundred bytes can decode to gigabytes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, UInt8

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("PNG", "JPEG", "TIFF")
"""Pillow reads more formats, some of which start other programs."""
COLOUR_MODES = {"RGB": "RGB", "RGBA": "RGBA", "L": "RGB", "LA": "RGBA", "1": "RGB"}
"""How each pillow mode of 8 bits is brought to RGB or RGBA; palettes are looked at separately."""

Size = tuple[int, int]
"""Height and width in pixels."""


class UnreadableImageError(ValueError):
    """A file is not a picture of the kind needed; the text says why and what to do."""


def read_colour(path: Path, size: Size) -> UInt8[np.ndarray, "H W C"]:
    """Read sRGB (C = 3) or sRGB with alpha (C = 4), 8 bits.

    Raises:
        UnreadableImageError: not a readable picture of this size with 8 bits a channel.
    """

    def convert(image: Image.Image) -> np.ndarray:
        if image.mode == "P":
            return np.asarray(image.convert("RGBA" if "transparency" in image.info else "RGB"))
        if image.mode not in COLOUR_MODES:
            raise UnreadableImageError(f"is a picture of mode {image.mode}; expected 8-bit RGB or RGBA")
        return np.asarray(image.convert(COLOUR_MODES[image.mode]))

    return _read(path, size, convert)


def read_labels(path: Path, size: Size) -> UInt8[np.ndarray, "H W"]:
    """Read class indices from an 8-bit picture of one channel (grey or palette; 255 = unlabelled).

    Raises:
        UnreadableImageError: not a readable picture of this size with one 8-bit channel.
    """

    def convert(image: Image.Image) -> np.ndarray:
        if image.mode not in ("L", "P"):
            raise UnreadableImageError(
                f"is a picture of mode {image.mode}; expected labels in one 8-bit channel"
            )
        return np.asarray(image)

    return _read(path, size, convert)


def read_mask(path: Path, size: Size) -> Bool[np.ndarray, "H W"]:
    """Read a mask: True where a pixel counts, False where it is black (nerfstudio's convention).

    Raises:
        UnreadableImageError: not a readable picture of this size.
    """
    return _read(path, size, lambda image: np.asarray(image.convert("L")) > 0)


def _read(path: Path, size: Size, convert: Callable[[Image.Image], np.ndarray]) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path, formats=FORMATS) as image:
            if (image.height, image.width) != size:
                raise UnreadableImageError(
                    f"the picture has {image.width} x {image.height} pixels (width x height); "
                    f"expected {size[1]} x {size[0]} as the cubes have"
                )
            return convert(image)
    except UnreadableImageError:
        raise
    # pillow reports damage as OSError, SyntaxError, ValueError, EOFError or a bomb error, by format
    except Exception as error:
        raise UnreadableImageError(
            f"cannot be read as a PNG, JPEG or TIFF picture ({type(error).__name__}: {error})"
        ) from error
