"""One HTML file about what has changed: before and after under a slider, what differs, and a list of places to click.

It holds all that it shows, and asks for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from unmix_plugin.comparing.comparison import TESTED, Comparison
from unmix_plugin.comparing.printed import amount_in_words
from unmix_plugin.comparing.shown import ChangeMap, ShownView, strip
from unmix_plugin.errors import counted
from unmix_plugin.figures.pictures import Picture
from unmix_plugin.formats.html import fill_template, picture_url
from unmix_plugin.trained.measures import describe_area, describe_scale

_LARGEST_SIDE_PX = 800
"""Larger pictures are shrunk."""


def changes_page(comparison: Comparison, views: Sequence[ShownView], maps: Sequence[ChangeMap]) -> bytes:
    """The bytes of the page."""
    values = {
        "title": f"What has changed: {comparison.before.name}, {comparison.after.name}",
        "facts": _facts(comparison),
        "notes": comparison.notes,
        "places": _rows(comparison),
        "view_names": [view.name for view in views],
        "scales": [
            {"title": one.title, "label": one.scale.label, "low": f"{one.scale.low:.3g}",
             "high": f"{one.scale.high:.3g}", "strip": _png_url(strip(one.scale))}
            for one in maps
        ],
        "data": {"views": [_view_data(comparison, view, maps) for view in views]},
    }  # fmt: skip
    page = fill_template("unmix_plugin.comparing", "changes.html", values)
    return page.encode("utf-8", "backslashreplace")


def _facts(comparison: Comparison) -> list[tuple[str, str]]:
    found, light = comparison.registration, comparison.registration.light
    return [
        (
            "Changed",
            f"{comparison.changed_area:.2%} of what both see, {counted(len(comparison.places), 'place')}",
        ),
        ("Registration", f"{found.rms_px:.2f} pixels rms, {found.overlap:.0%} overlap"),
        ("Light, after over before", f"{np.median(light):.3g} ({light.min():.3g} to {light.max():.3g})"),
        ("Materials", comparison.materials.in_words()),
        ("Bands", str(comparison.bands)),
        ("Lengths", describe_scale(comparison.before.scale)),
        ("False discoveries", f"at most {comparison.level:.0%} of the changed vertices"),
    ]


def _rows(comparison: Comparison) -> list[dict[str, str | int]]:
    return [
        {
            "number": place.number,
            "what": place.what,
            "map": TESTED.index(place.what),  # `change_maps` begins with maps of these
            "area": describe_area(place.area, comparison.before.scale),
            "center": ", ".join(f"{value:.3g}" for value in place.center),
            "amount": amount_in_words(comparison, place.number),
            "angle": _number(place.angle, 3),
            "brightness": _number(place.amounts["brightness"].mean, 2),
            "p": f"{place.p:.2g}",
        }
        for place in comparison.places
    ]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "not seen"


def _view_data(comparison: Comparison, view: ShownView, maps: Sequence[ChangeMap]) -> dict[str, Any]:
    """Pictures of a view as URLs, and where it shows which place: runs of equal numbers, row after row."""
    numbers = view.places(comparison)
    flat = numbers.ravel()
    ends = np.append(np.flatnonzero(np.diff(flat)) + 1, flat.size)
    lengths = np.diff(np.append(0, ends))
    middles = {}
    for number in np.unique(flat[flat > 0]):
        rows, columns = np.nonzero(numbers == number)
        reach = max(float(np.ptp(rows)), float(np.ptp(columns))) / 2 + 3
        middles[int(number)] = [float(columns.mean()) + 0.5, float(rows.mean()) + 0.5, reach, len(rows)]
    height, width = numbers.shape
    return {
        "name": view.name,
        "width": width,
        "height": height,
        "before": _png_url(view.before),
        "after": _png_url(view.after),
        "maps": [_png_url(one.painted(view, comparison.level)) for one in maps],
        "runs": [[int(flat[end - 1]), int(length)] for end, length in zip(ends, lengths, strict=True)],
        "middles": middles,
    }


def _png_url(image: Picture) -> str:
    return picture_url(np.asarray(image), _LARGEST_SIDE_PX)
