"""What the colours of an output's pictures mean: a figure with its scale and a swatch for each material."""

from __future__ import annotations

from typing import Any

from unmix_plugin.engine.registry import Output
from unmix_plugin.figures.pictures import ColourScale
from unmix_plugin.figures.plotting import draw_colour_bar, draw_swatch, figure_bytes
from unmix_plugin.products.render.formats import FormattedOutput
from unmix_plugin.products.render.pictures import Palette
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.trained_scene import TrainedScene

_WIDTH, _BAR_ROW, _NAME_ROW, _MARGIN = 5.2, 0.66, 0.26, 0.16
"""Inches."""
_NAMES_A_ROW = 3
_LONGEST_NAME = 24
_FONT_PT = 9


def needs_legend(formatted: FormattedOutput, scene: RenderableScene) -> bool:
    """Whether an output's pictures have colours that have to be explained, and that can be."""
    kind = formatted.output.kind
    has_meaning = kind in ("map", "shares") or (kind == "labels" and isinstance(scene, TrainedScene))
    return formatted.format in ("png", "mp4") and has_meaning


def draw_legend(output: Output, palette: Palette) -> bytes:
    """The legend of an output as a PNG."""
    from matplotlib.figure import Figure

    scale = palette.scale(output)
    has_names = output.kind in ("labels", "shares")
    names = list(zip(palette.names, palette.colours, strict=False)) if has_names else []
    bar = 0.0 if scale is None else _BAR_ROW
    height = 2 * _MARGIN + bar + -(-len(names) // _NAMES_A_ROW) * _NAME_ROW
    figure = Figure(figsize=(_WIDTH, height), facecolor="white")
    top = height - _MARGIN - bar
    if scale is not None:
        _draw_bar(figure, f"{output.name}: {scale.label}", scale, top, height)
    for index, (name, colour) in enumerate(names):
        row, column = divmod(index, _NAMES_A_ROW)
        left = _MARGIN + column * (_WIDTH - 2 * _MARGIN) / _NAMES_A_ROW
        bottom = top - (row + 1) * _NAME_ROW
        draw_swatch(figure, colour, (left, bottom + 0.05))
        place = ((left + 0.22) / _WIDTH, (bottom + 0.06) / height)
        figure.text(*place, name[:_LONGEST_NAME], fontsize=_FONT_PT, va="bottom")
    return figure_bytes(figure)


def _draw_bar(figure: Any, title: str, scale: ColourScale, bottom: float, height: float) -> None:
    box = (_MARGIN / _WIDTH, (bottom + 0.3) / height, 1 - 2 * _MARGIN / _WIDTH, 0.14 / height)
    bounds = (scale.low, scale.high)
    bar = draw_colour_bar(figure, figure.add_axes(box), scale.colour_map, bounds, "horizontal")
    bar.ax.tick_params(labelsize=_FONT_PT - 1, length=2, pad=2)
    bar.ax.set_title(title, fontsize=_FONT_PT, loc="left", pad=3)
