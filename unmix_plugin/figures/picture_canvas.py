"""A picture of tiles in a grid, each perhaps with its name above, filled row by row.

Notation: `h x W` pixels, some rows of the tiles; `T` tiles, `C` channels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from unmix_plugin.figures.picture_grid import columns_for

_CAPTION_PX = 18
_GAP_PX = 2
_FONT_PX = 11


def canvas_size(tile_size: tuple[int, int], num_captions: int) -> tuple[int, int]:
    """Width and height in pixels of a canvas of one tile without caption, or of as many tiles as captions.

    >>> canvas_size((96, 64), 0), canvas_size((96, 64), 7)
    ((96, 64), (390, 166))
    """
    width, height = tile_size
    count = max(1, num_captions)
    columns = columns_for(count)
    rows = -(-count // columns)
    above = _CAPTION_PX if num_captions else 0
    return columns * (width + _GAP_PX) - _GAP_PX, rows * (height + above + _GAP_PX) - _GAP_PX


class Canvas:
    """The picture under way; white and opaque where there is no tile."""

    def __init__(
        self,
        size: tuple[int, int],
        num_channels: int,
        captions: Sequence[str] = (),
        swatches: Sequence[Sequence[float] | np.ndarray] = (),
    ) -> None:
        """
        Args:
            size: Width and height of a tile in pixels.
            num_channels: 3 for colours, 4 with opacity.
            captions: One for each tile; none for one tile without a name.
            swatches: sRGB colours of small squares before the captions, in [0, 1]; one for each, or none.
        """
        self._width, self._height = size
        self._columns = columns_for(max(1, len(captions)))
        self._above = _CAPTION_PX if captions else 0
        width, height = canvas_size(size, len(captions))
        self.pixels: UInt8[np.ndarray, "H W C"] = np.full((height, width, num_channels), 255, dtype=np.uint8)
        """What is painted so far."""
        for index, caption in enumerate(captions):
            top, left = self._corner(index)
            strip = _caption(caption, self._width, swatches[index] if len(swatches) else None)
            self.pixels[top - self._above : top, left : left + self._width, :3] = strip

    def put(self, first_row: int, tiles: UInt8[np.ndarray, "h W T C"]) -> None:
        """Paint some rows of every tile."""
        for index in range(tiles.shape[2]):
            top, left = self._corner(index)
            top += first_row
            self.pixels[top : top + len(tiles), left : left + self._width] = tiles[:, :, index]

    def _corner(self, index: int) -> tuple[int, int]:
        row, column = divmod(index, self._columns)
        top = row * (self._height + self._above + _GAP_PX) + self._above
        return top, column * (self._width + _GAP_PX)


def _caption(
    text: str, width: int, swatch: Sequence[float] | np.ndarray | None
) -> UInt8[np.ndarray, "18 W 3"]:
    """A strip with a text, cut off where there is no room."""
    from PIL import Image, ImageDraw, ImageFont

    strip = Image.new("RGB", (width, _CAPTION_PX), "white")
    draw = ImageDraw.Draw(strip)
    left = 2
    if swatch is not None:
        red, green, blue = (round(255 * float(value)) for value in swatch)
        draw.rectangle((left, 4, left + 9, 13), fill=(red, green, blue), outline=(80, 80, 80))
        left += 14
    draw.text((left, 2), text, fill=(20, 20, 20), font=ImageFont.load_default(_FONT_PX))
    return np.asarray(strip)
