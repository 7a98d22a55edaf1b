"""The report for print: a PDF with what was found, a table of places, and the views."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from unmix_plugin.comparing.comparison import Comparison
from unmix_plugin.comparing.shown import ChangeMap, ShownView, panels
from unmix_plugin.engine.printing import plot_text
from unmix_plugin.errors import counted
from unmix_plugin.figures.plotting import page_in_inches
from unmix_plugin.trained.measures import describe_area, describe_length, describe_scale

_WIDTH, _HEIGHT, _MARGIN, _LINE = 8.27, 11.69, 0.7, 0.21
"""A4, inches."""
_LETTERS = 96
"""In a line."""
_COLUMNS = (0.0, 0.3, 1.4, 3.2, 5.2, 6.0)
_MOST_ROWS = 18
"""Of places, two lines each, with room for notes above them."""


def printed_report(comparison: Comparison, views: Sequence[ShownView], maps: Sequence[ChangeMap]) -> bytes:
    """The bytes of the PDF, the same for the same comparison."""
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with PdfPages(buffer, metadata={"CreationDate": None, "Title": "What has changed"}) as pages:
        pages.savefig(_first_page(comparison))
        for view in views:
            pages.savefig(_view_page(comparison, view, maps))
    return buffer.getvalue()


def _first_page(comparison: Comparison):  # noqa: ANN202 - a figure of matplotlib, which is imported where it is used
    from textwrap import wrap

    figure, page = page_in_inches(_WIDTH, _HEIGHT)
    top = _HEIGHT - _MARGIN

    def line(text: str, size: float | int = 9.0, left: float = 0.0, **looks: object) -> None:
        page.text(_MARGIN + left, top, plot_text(text), fontsize=size, va="top", **looks)

    line(f"What has changed: {comparison.before.name}, {comparison.after.name}", 15, fontweight="bold")
    top -= 2 * _LINE
    light = comparison.registration.light
    sentences = [
        comparison.registration.in_words(),
        f"light after over before: {np.median(light):.3g} ({light.min():.3g} to {light.max():.3g} over the bands)",
        str(comparison.bands),
        comparison.materials.in_words(),
        describe_scale(comparison.before.scale),
        f"changed: {comparison.changed_area:.2%} of what both see, {counted(len(comparison.places), 'place')}",
        f"false discoveries: at most {comparison.level:.0%} of the changed vertices",
        *comparison.notes,
    ]
    for text in sentences:
        for row in wrap(text, _LETTERS):
            line(row)
            top -= _LINE
    top -= _LINE
    heads = ("", "what", "area", "centre", "p", "angle, rad")
    for left, text in zip(_COLUMNS, heads, strict=True):
        line(text, 8, left, fontweight="bold")
    for place in comparison.places[:_MOST_ROWS]:
        top -= _LINE
        cells = (
            f"{place.number}",
            place.what,
            describe_area(place.area, comparison.before.scale),
            " ".join(f"{value:.3g}" for value in place.center),
            f"{place.p:.2g}",
            f"{place.angle:.3f}",
        )
        for left, text in zip(_COLUMNS, cells, strict=True):
            line(text, 8, left)
        top -= 0.75 * _LINE
        line(amount_in_words(comparison, place.number), 8, _COLUMNS[1])
    if len(comparison.places) > _MOST_ROWS:
        top -= _LINE
        line(f"and {len(comparison.places) - _MOST_ROWS} more in changes.csv", 8)
    return figure


def amount_in_words(comparison: Comparison, number: int) -> str:
    """How much stands out most at a place, with its interval."""
    place = comparison.places[number - 1]
    if place.what == "distance":
        amount, scale = place.amounts["distance"], comparison.before.scale
        low, high = (describe_length(value, scale) for value in (amount.low, amount.high))
        return f"{low} to {high}"
    brightness = place.amounts["brightness"]
    text = f"{brightness.low:.2f} to {brightness.high:.2f} times as bright"
    names = [name for name in place.amounts if name.startswith("abundance ")]
    name = max(names, key=lambda one: abs(np.nan_to_num(place.amounts[one].mean)))
    amount = place.amounts[name]
    if not amount.low * amount.high > 0:
        return text
    change = f"{name.removeprefix('abundance ')} {amount.low:+.2g} to {amount.high:+.2g}"
    return f"{text}, {change}" if place.what == "brightness" else change


def _view_page(comparison: Comparison, view: ShownView, maps: Sequence[ChangeMap]):  # noqa: ANN202 - the same
    from matplotlib.figure import Figure

    shown = panels(view, comparison, maps)
    columns = 3
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(_WIDTH, _HEIGHT), facecolor="white")
    figure.text(0.08, 0.96, plot_text(view.name), fontsize=13, fontweight="bold", va="top")
    colours = (
        "red is more and blue is less than before; faint where not significant, plain grey where not compared"
    )
    figure.text(0.08, 0.935, colours, fontsize=8, va="top")
    for index, panel in enumerate(shown):
        axes = figure.add_subplot(max(rows, 4), columns, index + 1)
        axes.imshow(np.clip(panel.image, 0, 1))
        axes.set_title(plot_text(panel.title), fontsize=8)
        axes.axis("off")
    return figure
