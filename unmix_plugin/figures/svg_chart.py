"""Line charts as SVG that stands inside an HTML page: sharp at any size, in the page's font, and searchable.

Coordinates inside a chart are in px of its view box, y downwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 14.0, 12.0, 44.0
_TICKS = 6


@dataclass(frozen=True)
class Line:
    """One line; where a value is not finite it has a gap."""

    x: np.ndarray
    y: np.ndarray
    label: str
    colour: str
    """As CSS has it."""
    width: float = 2.0
    dashes: str = ""
    """As SVG's stroke-dasharray has them; none for a solid line."""


@dataclass(frozen=True)
class Chart:
    """Lines over a common axis."""

    lines: Sequence[Line]
    x_label: str
    y_label: str
    description: str
    """For those who can't see it."""
    is_log: bool = False
    """Whether y is logarithmic; values that are not positive are then left out."""
    from_zero: bool = False
    """Whether y has to show 0."""
    size: tuple[float, float] = (640.0, 300.0)


def draw_chart(chart: Chart) -> str:
    """The chart as an `svg` element, without a legend."""
    width, height = chart.size
    points = [_finite(line, chart.is_log) for line in chart.lines]
    x_low, x_high = _range([x for x, _ in points], pad=0.0)
    y_low, y_high = _y_range([y for _, y in points], chart)
    to_x = _scale(x_low, x_high, _LEFT, width - _RIGHT)
    to_y = _scale(y_low, y_high, height - _BOTTOM, _TOP)
    y_ticks = _log_ticks(y_low, y_high) if chart.is_log else _ticks(y_low, y_high)
    parts = [
        f'<svg class="chart" viewBox="0 0 {width:g} {height:g}" role="img">',
        f"<title>{escape(chart.description)}</title>",
    ]
    parts += [_row(to_y(value), width, label) for value, label in y_ticks]
    parts += [_column(to_x(value), height, label) for value, label in _ticks(x_low, x_high)]
    parts += [_frame(chart, width, height)]
    for line, (x, y) in zip(chart.lines, points, strict=True):
        parts.append(_path(line, [(to_x(a), to_y(b)) for a, b in zip(x, y, strict=True)]))
    return "\n".join([*parts, "</svg>"])


def draw_legend(lines: Sequence[Line]) -> str:
    """Names of lines with a stroke of each, as HTML."""
    return f'<div class="legend">{"".join(draw_key(line) for line in lines)}</div>'


def draw_key(line: Line) -> str:
    """The name of a line with a stroke of it, as HTML."""
    stroke = f'<line x1="1" y1="5" x2="25" y2="5" {_stroke(line)}/>'
    return (
        f'<span class="key"><svg width="26" height="10" aria-hidden="true">{stroke}</svg>'
        f"{escape(line.label)}</span>"
    )


def _finite(line: Line, is_log: bool) -> tuple[np.ndarray, np.ndarray]:
    """The line's numbers as they are drawn; NaN where there is a gap."""
    x, y = np.asarray(line.x, dtype=np.float64), np.asarray(line.y, dtype=np.float64).copy()
    if is_log:
        y[~(y > 0)] = np.nan
        y = np.log10(y)
    y[~np.isfinite(y)] = np.nan
    return x, y


def _range(values: Sequence[np.ndarray], pad: float) -> tuple[float, float]:
    found = np.concatenate([one[np.isfinite(one)] for one in values]) if values else np.zeros(0)
    if found.size == 0:
        return 0.0, 1.0
    low, high = float(found.min()), float(found.max())
    if high - low < 1e-12 * max(abs(high), 1e-300):
        middle = 0.5 * abs(high) or 0.5
        return low - middle, high + middle
    return low - pad * (high - low), high + pad * (high - low)


def _y_range(values: Sequence[np.ndarray], chart: Chart) -> tuple[float, float]:
    low, high = _range(values, pad=0.06)
    if chart.from_zero and not chart.is_log:
        return min(low, 0.0) if low < -1e-9 * abs(high) and _least(values) < 0 else 0.0, max(high, 0.0)
    return low, high


def _least(values: Sequence[np.ndarray]) -> float:
    return min((float(np.nanmin(one)) for one in values if np.isfinite(one).any()), default=0.0)


def _scale(low: float, high: float, first: float, last: float):  # noqa: ANN202 - a function of one number
    return lambda value: first + (value - low) / (high - low) * (last - first)


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Round numbers inside a range, about six."""
    rough = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough)
    first = math.ceil(low / step - 1e-9)
    values = [index * step for index in range(first, math.floor(high / step + 1e-9) + 1)]
    return [(value, f"{0.0 if abs(value) < step / 1e6 else value:.10g}") for value in values]


def _log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Powers of ten, with 2 and 5 times them where there are few."""
    factors = (1, 2, 5) if high - low < 2 else (1,)
    found = [
        (math.log10(factor) + power, f"{factor * 10.0**power:.3g}")
        for power in range(math.floor(low), math.ceil(high) + 1)
        for factor in factors
    ]
    return [(value, label) for value, label in found if low <= value <= high]


def _row(y: float, width: float, label: str) -> str:
    return (
        f'<line class="grid" x1="{_LEFT:g}" x2="{width - _RIGHT:g}" y1="{y:.1f}" y2="{y:.1f}"/>'
        f'<text class="tick" x="{_LEFT - 7:g}" y="{y + 4:.1f}" text-anchor="end">{label}</text>'
    )


def _column(x: float, height: float, label: str) -> str:
    base = height - _BOTTOM
    return (
        f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{base:g}" y2="{base + 5:g}"/>'
        f'<text class="tick" x="{x:.1f}" y="{base + 19:g}" text-anchor="middle">{label}</text>'
    )


def _frame(chart: Chart, width: float, height: float) -> str:
    base, middle = height - _BOTTOM, (_LEFT + width - _RIGHT) / 2
    side = (_TOP + base) / 2
    return (
        f'<line class="axis" x1="{_LEFT:g}" x2="{width - _RIGHT:g}" y1="{base:g}" y2="{base:g}"/>'
        f'<text class="label" x="{middle:g}" y="{height - 6:g}" text-anchor="middle">{escape(chart.x_label)}</text>'
        f'<text class="label" transform="translate(13 {side:g}) rotate(-90)" text-anchor="middle">'
        f"{escape(chart.y_label)}</text>"
    )


def _path(line: Line, points: Sequence[tuple[float, float]]) -> str:
    commands: list[str] = []
    is_drawing = False
    for x, y in points:
        if math.isfinite(x) and math.isfinite(y):
            commands.append(f"{'L' if is_drawing else 'M'}{x:.2f} {y:.2f}")
        is_drawing = math.isfinite(x) and math.isfinite(y)
    return f'<path d="{"".join(commands)}" fill="none" {_stroke(line)}><title>{escape(line.label)}</title></path>'


def _stroke(line: Line) -> str:
    dashes = f' stroke-dasharray="{line.dashes}"' if line.dashes else ""
    return f'stroke="{escape(line.colour, quote=True)}" stroke-width="{line.width:g}" stroke-linejoin="round"{dashes}'
