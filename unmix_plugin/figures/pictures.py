"""Figures as PNG: grids of pictures with titles, a colour bar, a legend.

Everything is placed in inches, so that nothing is cut off, however many panels or names there are. Where a picture
shows nothing it fades into a neutral light grey.

Pictures of tiles in a grid, each perhaps with its name above, are filled row by row.

Notation: pictures are (H, W, 3) sRGB in [0, 1]; `h x W` pixels, some rows of the tiles; `T` tiles, `C` channels.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from unmix_plugin.engine.printing import plot_text
from unmix_plugin.figures.paint import ColourScale
from unmix_plugin.figures.plotting import (
    FIGURE_DPI,
    Colour,
    draw_colour_bar,
    draw_swatch,
    figure_bytes,
    page_in_inches,
)
from unmix_plugin.formats.files import rgba_png_bytes

_FONT_PT = 10
_MARGIN, _GAP, _TITLE, _HEADING, _LEGEND_ROW = 0.15, 0.14, 0.30, 0.34, 0.25
_BAR_WIDTH, _BAR_SPACE = 0.16, 0.80
_LETTER, _HEADING_LETTER = 0.075, 0.115
"""Widths of a letter, generous."""
_PANEL_BOUNDS = (2.1, 5.0)
"""Least and greatest longer side of a panel."""

Picture = Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class TitledPicture:
    """One picture of a figure."""

    image: Picture
    title: str
    swatch: Colour | None = None
    """sRGB colour of a small square before the title."""


def columns_for(count: int) -> int:
    """Columns of a grid of `count` panels that is wider than high."""
    return count if count <= 4 else max(4, int(np.ceil(np.sqrt(1.6 * count))))


def in_rows(panels: Sequence[TitledPicture], columns: int | None = None) -> list[Sequence[TitledPicture]]:
    """Panels in rows of equal length, the last one perhaps shorter."""
    width = columns or columns_for(len(panels))
    return [panels[i : i + width] for i in range(0, len(panels), width)]


def draw_panels(
    rows: Sequence[Sequence[TitledPicture]],
    heading: str,
    scale: ColourScale | None = None,
    legend: Sequence[tuple[str, Colour]] = (),
) -> bytes:
    """A grid of panels, all of one picture size, as a PNG: heading above, colour bar on the right, legend below."""
    from matplotlib.ticker import MaxNLocator

    height_px, width_px, _ = rows[0][0].image.shape
    longer = float(np.clip(max(height_px, width_px) / FIGURE_DPI, *_PANEL_BOUNDS))
    size = (longer * width_px / max(height_px, width_px), longer * height_px / max(height_px, width_px))
    width = max(size[0], 1.3)  # room for a title
    num_columns = max(len(row) for row in rows)
    bar = 0.0 if scale is None else _BAR_SPACE
    grid_width = num_columns * (width + _GAP) - _GAP
    inner_width = max(grid_width + bar, _HEADING_LETTER * len(heading), _entry_width(legend))
    below = legend_height(legend, inner_width) + (_GAP if legend else 0.0)
    grid_height = len(rows) * (size[1] + _TITLE + _GAP) - _GAP
    top = _MARGIN + below + grid_height + _HEADING
    figure, page = page_in_inches(inner_width + 2 * _MARGIN, top + _MARGIN)
    page.text(_MARGIN, top, plot_text(heading), fontsize=_FONT_PT + 2, fontweight="bold", va="top")
    for row, panels in enumerate(rows):
        bottom = top - _HEADING - (row + 1) * (size[1] + _TITLE) - row * _GAP
        for column, panel in enumerate(panels):
            _draw_panel(page, panel, (_MARGIN + column * (width + _GAP), bottom), size, width)
    if scale is not None:
        box = (_MARGIN + grid_width + 0.18, _MARGIN + below, _BAR_WIDTH, grid_height - _TITLE)
        drawn = draw_colour_bar(page, box, scale.colour_map, (scale.low, scale.high))
        drawn.set_label(plot_text(scale.label), fontsize=_FONT_PT)
        drawn.ax.tick_params(labelsize=_FONT_PT - 1)
        drawn.locator = MaxNLocator(5)
    draw_legend_entries(page, legend, (_MARGIN, _MARGIN + below - _GAP), inner_width)
    return figure_bytes(figure)


def legend_height(legend: Sequence[tuple[str, Colour]], width: float) -> float:
    """Inches that the entries take on a page so wide."""
    return _LEGEND_ROW * -(-len(legend) // max(1, int(width / _entry_width(legend))))


def draw_legend_entries(
    page: Any, legend: Sequence[tuple[str, Colour]], corner: tuple[float, float], width: float
) -> None:
    """Swatches and names on a page in inches, in rows of this width; the corner is their left and top."""
    columns = max(1, int(width / _entry_width(legend)))
    for index, (name, colour) in enumerate(legend):
        row, column = divmod(index, columns)
        left, base = corner[0] + column * _entry_width(legend), corner[1] - (row + 1) * _LEGEND_ROW
        draw_swatch(page, colour, (left, base + 0.02))
        page.text(left + 0.24, base + 0.03, plot_text(name), fontsize=_FONT_PT, va="bottom")


def one_above_the_other(paths: Sequence[Path], captions: Sequence[str]) -> bytes:
    """Pictures in files as one PNG, each below its caption."""
    from PIL import Image, ImageDraw, ImageFont

    sizes = []
    for path in paths:
        with Image.open(path) as picture:
            sizes.append(picture.size)
    height = sum(high + _STRIP_PX for _, high in sizes)
    page = Image.new("RGB", (max(wide for wide, _ in sizes), height), "white")
    draw, top = ImageDraw.Draw(page), 0
    for path, caption, (_, high) in zip(paths, captions, sizes, strict=True):
        draw.text((20, top + 8), caption, fill=(20, 20, 20), font=ImageFont.load_default(_STRIP_PX / 2))
        with Image.open(path) as picture:
            page.paste(picture, (0, top + _STRIP_PX))
        top += high + _STRIP_PX
    return rgba_png_bytes(np.asarray(page))


def _draw_panel(
    page: Any, panel: TitledPicture, corner: tuple[float, float], size: tuple[float, float], width: float
) -> None:
    """A panel on a page, `width` wide in all, with its title above."""
    from matplotlib.patches import Rectangle

    left, bottom = corner
    left_of_picture = left + (width - size[0]) / 2
    extent = (left_of_picture, left_of_picture + size[0], bottom, bottom + size[1])
    page.imshow(np.clip(panel.image, 0, 1), extent=extent, aspect="auto")
    frame = Rectangle((left_of_picture, bottom), *size, fill=False, edgecolor="0.75", linewidth=0.8)
    page.add_patch(frame)
    base = bottom + size[1] + 0.09
    if panel.swatch is not None:
        draw_swatch(page, panel.swatch, (left, base))
        left, width = left + 0.22, width - 0.22
    title = textwrap.shorten(panel.title, max(8, int(width / _LETTER)), placeholder="...")
    page.text(left, base, plot_text(title), fontsize=_FONT_PT, va="bottom")


def _entry_width(legend: Sequence[tuple[str, Colour]]) -> float:
    """Inches that one entry takes."""
    return 0.52 + _LETTER * max((len(name) for name, _ in legend), default=8)


_STRIP_PX = 40
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
        """The layout of one tile without a name, or of `count` tiles (None: one for each name) with room for the names
        that they may have.

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
        """3 channels are colours, a fourth is opacity; captions and swatches before them one for each tile, or none."""
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
