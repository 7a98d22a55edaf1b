"""Line charts as SVG: sharp at any size."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unmix_plugin.figures.plotting import plain_axes

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
class LineChart:
    """Lines over a common axis."""

    lines: Sequence[ChartLine]
    x_label: str
    y_label: str
    is_log: bool = False
    """Whether y is logarithmic; values that are not positive are then left out."""
    from_zero: bool = False
    """Whether y has to show 0."""
    size: tuple[float, float] = (640.0, 300.0)
    """Width and height in px."""


def draw_chart(chart: LineChart) -> bytes:
    """The chart as an SVG file, without a legend; text is drawn as shapes, so that no font is needed."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": _FONT_PX, "svg.hashsalt": "chart", "axes.linewidth": 0.8}):
        # An SVG has 72 units an inch, so that a unit is a px.
        figure = Figure(figsize=(chart.size[0] / 72, chart.size[1] / 72), layout="constrained")
        axes = figure.add_subplot()
        for line in chart.lines:
            axes.plot(line.x, line.y, color=line.colour, linewidth=line.width, linestyle=line.dash)
        if chart.is_log and any((np.asarray(line.y) > 0).any() for line in chart.lines):
            axes.set_yscale("log", nonpositive="mask")
        elif chart.from_zero:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, 0.0) if _least(chart) < 0 else 0.0, max(high, 0.0))
        axes.margins(x=0)
        axes.set_xlabel(chart.x_label, color=_INK)
        axes.set_ylabel(chart.y_label, color=_INK)
        axes.tick_params(which="both", colors=_SOFT)
        plain_axes(axes)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return buffer.getvalue()


def _least(chart: LineChart) -> float:
    values = np.concatenate([np.asarray(line.y, dtype=np.float64) for line in chart.lines])
    return float(values[np.isfinite(values)].min(initial=0.0))
