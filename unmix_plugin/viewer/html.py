"""Small pieces of HTML for the panels. Every text is escaped: names of endmembers are users' own words."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.viewer.layers.painting import ColourMapLegend, Legend, SwatchLegend, colour_table

_NUM_STOPS = 17
_BLOCK = "padding:0.2em 0.8em;font-size:0.85em;line-height:1.35"


def paragraph(text: str, is_warning: bool = False) -> str:
    """A line of text."""
    colour = ";color:#c92a2a" if is_warning else ""
    return f'<div style="{_BLOCK}{colour}">{escape(text)}</div>'


def legend(shown: Legend) -> str:
    """What the colours of a picture mean."""
    if isinstance(shown, ColourMapLegend):
        return _colour_bar(shown)
    if isinstance(shown, SwatchLegend):
        return swatches(shown.entries)
    return paragraph(shown.text)


def bars(entries: Sequence[tuple[str, float, Sequence[float]]]) -> str:
    """Names, values in [0, 1] and sRGB colours as horizontal bars."""
    rows = []
    for name, value, colour in entries:
        width = 100 * min(max(value, 0.0), 1.0)
        rows.append(
            '<div style="display:flex;align-items:center;gap:0.5em">'
            f'<span style="flex:0 0 8.5em;overflow:hidden;text-overflow:ellipsis">{escape(name)}</span>'
            '<span style="flex:1;background:#8883;height:0.8em">'
            f'<span style="display:block;height:100%;width:{width:.1f}%;background:{css_colour(colour)}"></span></span>'
            f'<span style="flex:0 0 2.6em;text-align:right">{value:.2f}</span></div>'
        )
    return f'<div style="{_BLOCK}">{"".join(rows)}</div>'


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Names and values side by side."""
    cells = "".join(
        f'<tr><td style="padding-right:1em;opacity:0.7">{escape(name)}</td><td>{escape(value)}</td></tr>'
        for name, value in rows
    )
    return f'<div style="{_BLOCK}"><table>{cells}</table></div>'


def _colour_bar(shown: ColourMapLegend) -> str:
    table_rows = colour_table(shown.colour_map)
    chosen = np.linspace(0, len(table_rows) - 1, _NUM_STOPS).round().astype(int)
    stops = ",".join(css_colour(table_rows[index].tolist()) for index in chosen)
    return (
        f'<div style="{_BLOCK}"><div>{escape(shown.label)}</div>'
        f'<div style="height:0.9em;background:linear-gradient(to right,{stops})"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{shown.low:.4g}</span><span>{(shown.low + shown.high) / 2:.4g}</span>"
        f"<span>{shown.high:.4g}</span></div></div>"
    )


def swatches(entries: Sequence[tuple[str, Sequence[float]]]) -> str:
    items = "".join(
        '<div style="display:flex;align-items:center;gap:0.5em">'
        f'<span style="width:0.9em;height:0.9em;background:{css_colour(colour)}"></span>{escape(name)}</div>'
        for name, colour in entries
    )
    return f'<div style="{_BLOCK}">{items}</div>'
