"""What the colours of a render mean, as files of their own: a picture and a table."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from unmix_plugin.engine.outputs import Output
from unmix_plugin.engine.printing import plot_text
from unmix_plugin.figures.paint import ColourScale, Legend
from unmix_plugin.figures.pictures import draw_legend_entries, legend_height
from unmix_plugin.figures.plotting import Colour, draw_colour_bar, figure_bytes, page_in_inches
from unmix_plugin.formats.files import csv_bytes
from unmix_plugin.spectral.segmentation import NOTHING_ID

_WIDTH, _BAR_ROW, _MARGIN = 5.2, 0.66, 0.16
"""Inches."""
_LONGEST_NAME = 30
_FONT_PT = 9


def legend_csv(classes: Iterable[tuple[str, Colour]], nothing: Colour | None = None) -> bytes:
    """What ids mean, counted from 0: `id,name,red,green,blue`, sRGB 0 to 255; and `nothing`, if it has a colour."""
    named = [(index, name, colour) for index, (name, colour) in enumerate(classes)]
    named += [] if nothing is None else [(NOTHING_ID, "nothing", nothing)]
    rows = [[index, name, *np.round(255 * np.asarray(colour)).astype(int)] for index, name, colour in named]
    return csv_bytes([["id", "name", "red", "green", "blue"], *rows])


def draw_legend(output: Output, legend: Legend) -> bytes:
    """The legend of an output as a PNG: its colour bar, and the names of its classes."""
    scale, width = legend if isinstance(legend, ColourScale) else None, _WIDTH - 2 * _MARGIN
    names = [(name[:_LONGEST_NAME], colour) for name, colour in output.classes]
    names_height = legend_height(names, width) if names else 0.0
    height = 2 * _MARGIN + (0.0 if scale is None else _BAR_ROW) + names_height
    figure, page = page_in_inches(_WIDTH, height)
    if scale is not None:
        box = (_MARGIN, _MARGIN + names_height + 0.3, width, 0.14)
        drawn = draw_colour_bar(page, box, scale.colour_map, (scale.low, scale.high), "horizontal")
        drawn.ax.tick_params(labelsize=_FONT_PT - 1, length=2, pad=2)
        drawn.ax.set_title(plot_text(f"{output.name}: {scale.label}"), fontsize=_FONT_PT, loc="left", pad=3)
    draw_legend_entries(page, names, (_MARGIN, _MARGIN + names_height), width)
    return figure_bytes(figure)
