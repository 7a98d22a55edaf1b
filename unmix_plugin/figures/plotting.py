"""What all figures share: resolution, swatches, plain axes; line charts as SVG; and a colour for each material, its own
where that can be told from the others, otherwise the nearest that can.

Notation: `K` materials, `N` colours; `lab` is CIE 1976 L*a*b* of sRGB colours under D65, in which equal distances look
about equally different.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine.printing import plot_text
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.colour.difference import srgb_to_lab
from unmix_plugin.spectral.colour.srgb import encode_srgb

FIGURE_DPI = 130
RIGHT, WRONG = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
"""sRGB of pixels with the right and with the wrong material: white and black, which no material has."""

Colour = Sequence[float] | np.ndarray
"""sRGB in [0, 1]."""


def figure_bytes(figure: Any) -> bytes:
    """A matplotlib figure as the bytes of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=FIGURE_DPI)
    return buffer.getvalue()


def css_colour(srgb: Colour) -> str:
    """An sRGB colour as CSS has it.

    >>> css_colour((1.0, 0.5, 0.0))
    '#ff8000'
    """
    return "#" + "".join(f"{round(255 * min(max(float(value), 0.0), 1.0)):02x}" for value in srgb)


def page_in_inches(width: float, height: float) -> tuple[Any, Any]:
    """A white figure, and axes without ticks that fill it, whose unit is an inch: whatever is placed on them lies where
    it is said to."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="white")
    page = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height))
    page.axis("off")
    return figure, page


def draw_swatch(
    page: Any, colour: Colour, corner: tuple[float, float], side: float = 0.15, edge: str = "0.3"
) -> None:
    """A square of a colour on a page, by its left and bottom; `edge` is the colour of its outline, or `none`."""
    from matplotlib.patches import Rectangle

    fill = tuple(np.clip(colour, 0, 1))
    page.add_patch(Rectangle(corner, side, side, facecolor=fill, edgecolor=edge, linewidth=0.6))


def draw_colour_bar(
    page: Any,
    box: tuple[float, float, float, float],
    colour_map: str,
    bounds: tuple[float, float],
    orientation: str = "vertical",
) -> Any:
    """A colour bar over `bounds` in a box (left, bottom, width, height) of a page; matplotlib's, for labels."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = page.inset_axes(box, transform=page.transData)
    mapped = ScalarMappable(Normalize(*bounds), colour_map)
    return page.figure.colorbar(mapped, cax=axes, orientation=orientation)


def plain_axes(axes: Any) -> None:
    """Axes with a light grid behind the lines, open above and on the right."""
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def mark_lone_points(axes: Any) -> None:
    """Give a dot to each value that no line can lead to: those beside it are missing."""
    for line in axes.get_lines():
        is_known = np.pad(np.isfinite(np.asarray(line.get_ydata(), dtype=np.float64)), 1)
        is_alone = is_known[1:-1] & ~is_known[:-2] & ~is_known[2:]
        if is_alone.any():
            size = 2 * line.get_linewidth()
            line.set(marker="o", markevery=is_alone, markersize=size, markeredgecolor="none")


_FONT_PX = 12
_INK, _SOFT = "#1c2024", "#5d6670"


@dataclass(frozen=True)
class ChartLine:
    """One line; where a value is not finite it has a gap."""

    x: np.ndarray
    y: np.ndarray
    label: str
    colour: str
    """A CSS colour, `#rrggbb`."""
    width: float = 2.0
    """In px."""
    dash: str = "solid"
    """solid, dashed or dotted, as matplotlib and CSS both call it."""


@dataclass(frozen=True)
class SpectraChart:
    """Lines over wavelength, above a zero that is shown."""

    lines: Sequence[ChartLine]
    label: str
    """Of what stands over wavelength."""
    size: tuple[float, float] = (480.0, 240.0)
    """Width and height in px."""


def draw_chart(chart: SpectraChart) -> bytes:
    """The chart as an SVG file, without a legend; text is drawn as shapes, so that no font is needed."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": _FONT_PX, "svg.hashsalt": "chart", "axes.linewidth": 0.8}):
        # An SVG has 72 units an inch, so that a unit is a px.
        figure = Figure(figsize=(chart.size[0] / 72, chart.size[1] / 72), layout="constrained")
        axes = figure.add_subplot()
        for line in chart.lines:
            axes.plot(line.x, line.y, color=line.colour, linewidth=line.width, linestyle=line.dash)
        low, high = axes.get_ylim()
        values = np.concatenate([np.asarray(line.y, dtype=np.float64) for line in chart.lines])
        least = values[np.isfinite(values)].min(initial=0.0)
        axes.set_ylim(min(low, 0.0) if least < 0 else 0.0, max(high, 0.0))
        mark_lone_points(axes)
        axes.margins(x=0)
        axes.set_xlabel("wavelength (nm)", color=_INK)
        axes.set_ylabel(plot_text(chart.label), color=_INK)
        axes.tick_params(which="both", colors=_SOFT)
        plain_axes(axes)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return buffer.getvalue()


_LIGHTNESS_BOUNDS = (30.0, 85.0)
"""L* of colours that stand out from a light page and from black text."""

_DISTANCE = 32.0
"""Distance in L*a*b* of the colours of any two materials, as long as there is room for it."""

_LEVELS = 21
"""Steps of each sRGB channel among which colours are looked for."""


def id_colours() -> Float64[np.ndarray, "255 3"]:
    """sRGB colours of ids that have no colours of their own, neighbours well apart; they come again after 20."""
    from matplotlib import colormaps

    return colormaps["tab20"](np.arange(255) % 20)[:, :3].astype(np.float64)


def own_colours(spectra: Float[Tensor, "K B"], bands: Bands) -> Float64[np.ndarray, "K 3"]:
    """The sRGB colour of each spectrum, [0, 1]: what a surface of it looks like, or its false colour."""
    linear = spectra.detach().cpu().double().clamp(min=0) @ rgb_matrix(bands, torch.float64)
    return encode_srgb(linear.clamp(0, 1).numpy())


def distinct_colours(own_srgb: Float[np.ndarray, "K 3"]) -> Float64[np.ndarray, "K 3"]:
    """sRGB colours near the given ones, any two well apart, all visible on a light page; the first have first choice.

    >>> distinct_colours(np.array([[0.8, 0.2, 0.2], [0.2, 0.3, 0.8]])).round(2)
    array([[0.8, 0.2, 0.2],
           [0.2, 0.3, 0.8]])
    """
    distance = _DISTANCE
    while (chosen := _choose_apart(srgb_to_lab(own_srgb), distance)) is None:
        distance *= 0.9
    return chosen


def _choose_apart(wanted: Float64[np.ndarray, "K 3"], distance: float) -> Float64[np.ndarray, "K 3"] | None:
    """For each wanted colour in turn the nearest that is `distance` from those before; None if one has no place."""
    srgb, lab = _visible_colours()
    is_free = np.ones(len(lab), dtype=bool)
    chosen: list[int] = []
    for colour in wanted:
        if not is_free.any():
            return None
        to_wanted = np.where(is_free, np.linalg.norm(lab - colour, axis=1), np.inf)
        chosen.append(int(to_wanted.argmin()))
        is_free &= np.linalg.norm(lab - lab[chosen[-1]], axis=1) >= distance
    return srgb[chosen]


@lru_cache(maxsize=1)
def _visible_colours() -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Colours to choose from, as sRGB and as L*a*b*."""
    levels = np.linspace(0, 1, _LEVELS)
    srgb = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    lab = srgb_to_lab(srgb)
    low, high = _LIGHTNESS_BOUNDS
    visible = (lab[:, 0] >= low) & (lab[:, 0] <= high)
    return srgb[visible], lab[visible]
