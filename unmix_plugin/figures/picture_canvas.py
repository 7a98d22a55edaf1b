"""A picture of tiles in a grid, each perhaps with its name above, filled row by row.

Notation: `h x W` pixels, some rows of the tiles; `T` tiles, `C` channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import UInt8

from unmix_plugin.figures.picture_grid import columns_for
from unmix_plugin.figures.plotting import Colour

_CAPTION_PX, _GAP_PX, _FONT_PX = 18, 2, 11
_SWATCH_PX = 14
"""Width of a swatch and the space behind it."""
_LONGEST_CAPTION_PX = 240


@dataclass(frozen=True)
class CanvasLayout:
    """Where tiles are: in a grid, in columns that are wide enough for their names."""

    tile_size: tuple[int, int]
    """Width and height of a tile in pixels."""
    count: int
    """Number of tiles."""
    column_px: int
    """Width of a column."""
    above_px: int
    """Height of a name above its tile."""

    @staticmethod
    def of(
        tile_size: tuple[int, int], captions: Sequence[str] = (), count: int | None = None
    ) -> CanvasLayout:
        """The layout of one tile without a name, or of tiles with room for names.

        Args:
            tile_size: Width and height of a tile in pixels.
            captions: Every name that a tile may have.
            count: Number of tiles; None: that of the names.

        >>> CanvasLayout.of((96, 64)).size, CanvasLayout.of((96, 64), ["oak"] * 7).size
        ((96, 64), (390, 166))
        """
        if count is None:
            count = max(1, len(captions))
        widest = max(map(_text_px, captions), default=0) + (_SWATCH_PX if count > 1 else 0)
        column_px = max(tile_size[0], min(widest, _LONGEST_CAPTION_PX))
        return CanvasLayout(tile_size, count, column_px, _CAPTION_PX if captions else 0)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole in pixels."""
        columns = columns_for(self.count)
        rows = -(-self.count // columns)
        height = rows * (self.tile_size[1] + self.above_px + _GAP_PX) - _GAP_PX
        return columns * (self.column_px + _GAP_PX) - _GAP_PX, height

    def corner(self, index: int) -> tuple[int, int]:
        """Row and column of a tile's first pixel."""
        row, column = divmod(index, columns_for(self.count))
        top = row * (self.tile_size[1] + self.above_px + _GAP_PX) + self.above_px
        return top, column * (self.column_px + _GAP_PX)


class Canvas:
    """The picture under way; white and opaque where there is no tile."""

    def __init__(
        self,
        layout: CanvasLayout,
        num_channels: int,
        captions: Sequence[str] = (),
        swatches: Sequence[Colour] | np.ndarray = (),
    ) -> None:
        """
        Args:
            layout: Where tiles are.
            num_channels: 3 for colours, 4 with opacity.
            captions: One for each tile; none for one tile without a name.
            swatches: Colours of small squares before the captions; one for each, or none.
        """
        self._layout = layout
        width, height = layout.size
        self.pixels: UInt8[np.ndarray, "H W C"] = np.full((height, width, num_channels), 255, dtype=np.uint8)
        """What is painted so far."""
        for index, caption in enumerate(captions):
            top, left = layout.corner(index)
            strip = _caption(caption, layout.column_px, swatches[index] if len(swatches) else None)
            self.pixels[top - layout.above_px : top, left : left + layout.column_px, :3] = strip

    def put(self, first_row: int, tiles: UInt8[np.ndarray, "h W T C"]) -> None:
        """Paint some rows of every tile."""
        for index in range(tiles.shape[2]):
            top, left = self._layout.corner(index)
            top += first_row
            self.pixels[top : top + len(tiles), left : left + tiles.shape[1]] = tiles[:, :, index]


@lru_cache(maxsize=1)
def _font() -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(_FONT_PX)


def _text_px(text: str) -> int:
    """Width of a text with a little space on both sides."""
    return int(np.ceil(_font().getlength(text))) + 4


def _caption(text: str, width: int, swatch: Colour | None) -> UInt8[np.ndarray, "18 W 3"]:
    """A strip with a text, shortened where there is no room."""
    from PIL import Image, ImageDraw

    strip = Image.new("RGB", (width, _CAPTION_PX), "white")
    draw = ImageDraw.Draw(strip)
    left = 2
    if swatch is not None:
        red, green, blue = (round(255 * float(value)) for value in swatch)
        draw.rectangle((left, 4, left + 9, 13), fill=(red, green, blue), outline=(80, 80, 80))
        left += _SWATCH_PX
    shown = text
    while len(shown) > 1 and left + _text_px(shown) > width + 2:
        shown = shown.removesuffix("…")[:-1] + "…"
    draw.text((left, 2), shown, fill=(20, 20, 20), font=_font())
    return np.asarray(strip)
