"""What all matplotlib figures share: resolution, swatches, plain axes, and colours of right and wrong."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

FIGURE_DPI = 130
RIGHT, WRONG = (0.80, 0.84, 0.80), (0.80, 0.15, 0.15)
"""sRGB of pixels with the right and with the wrong material."""

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


def draw_swatch(
    figure: Any, colour: Colour, corner: tuple[float, float], side: float = 0.15, edge: str = "0.3"
) -> None:
    """A square of a colour.

    Args:
        figure: To draw on.
        colour: Clipped to [0, 1].
        corner: Left and bottom in inches.
        side: Inches.
        edge: Colour of its outline, `none` for no outline.
    """
    from matplotlib.patches import Rectangle

    width, height = figure.get_size_inches()
    square = Rectangle(
        (corner[0] / width, corner[1] / height),
        side / width,
        side / height,
        transform=figure.transFigure,
        facecolor=tuple(np.clip(colour, 0, 1)),
        edgecolor=edge,
        linewidth=0.6,
    )
    figure.add_artist(square)


def draw_colour_bar(
    figure: Any, axes: Any, colour_map: str, bounds: tuple[float, float], orientation: str = "vertical"
) -> Any:
    """A colour bar over `bounds` that fills `axes`; matplotlib's, for labels and ticks."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return figure.colorbar(ScalarMappable(Normalize(*bounds), colour_map), cax=axes, orientation=orientation)


def plain_axes(axes: Any) -> None:
    """Axes with a light grid behind the lines, open above and on the right."""
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
