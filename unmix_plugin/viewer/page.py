"""One page in a browser: what comes from it, checked; what it is told and shown."""

from __future__ import annotations

import logging
import math
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Float

from unmix_plugin.engine.printing import terminal_text
from unmix_plugin.engine.runs.replacing import claim
from unmix_plugin.errors import ConfigError, UnmixError
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.formats.files import make_folder, safe_name, write_errors_as
from unmix_plugin.spectral.intervals import Interval

if TYPE_CHECKING:
    import viser


_LONGEST_TEXT = 100_000
"""Letters of a text that are looked at."""

_LOG = logging.getLogger("unmix_plugin.viewer")
_ChoiceT = TypeVar("_ChoiceT")
_FallbackT = TypeVar("_FallbackT")


def number(value: Any, low: float | int, high: float | int, fallback: float | int) -> float:
    """A number within [low, high]; `fallback` for what is not a number or not finite.

    >>> number(7, 0, 5, fallback=1), number("x", 0, 5, fallback=1), number(float("nan"), 0, 5, fallback=1)
    (5.0, 1.0, 1.0)
    """
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        return float(fallback)
    return min(max(found, float(low)), float(high)) if math.isfinite(found) else float(fallback)


def number_of(control: Any, fallback: float | int) -> float:
    """The number that a control has, within the control's own bounds; `fallback` for what is none."""
    return number(control.value, control.min, control.max, fallback)


def choice(value: Any, known: Collection[_ChoiceT], fallback: _FallbackT) -> _ChoiceT | _FallbackT:
    """The value if it is one of `known`, otherwise `fallback`."""
    return next((one for one in known if type(one) is type(value) and one == value), fallback)


def index_in(menu: Any) -> int:
    """Which of a menu's options is chosen; a ConfigError if none of them."""
    options = tuple(menu.options)
    if menu.value not in options:
        raise ConfigError(f"there is no {menu.label} {str(menu.value)[:40]!r}")
    return options.index(menu.value)


def text(value: Any) -> str:
    """What was typed, cut to `_LONGEST_TEXT`; empty for what is not text."""
    return value[:_LONGEST_TEXT] if isinstance(value, str) else ""


def new_file(folder: Path, name: Any, suffix: str, fallback: str) -> Path:
    """A path directly in `folder`, which is made, that no file had, and no other page gets: an empty file claims it. It
    is named as asked as far as that is safe: anything but letters, digits, `_`, `+`, `-` and inner dots becomes `_`,
    and where nothing is left the name is `fallback`. A ConfigError if there are too many files of that name, a RunError
    if the folder can't be written."""
    make_folder(folder)
    stem = safe_name(text(name).strip().removesuffix(suffix).strip("._/\\"), fallback=fallback)
    for count in range(1, 10_000):
        path = folder / f"{stem if count == 1 else f'{stem}-{count}'}{suffix}"
        with write_errors_as(path):
            if claim(path):
                return path
    raise ConfigError(f"too many files named {stem} in {folder}; choose another name")


@contextmanager
def reporting_failures(what: str, say: Callable[[str], None]) -> Iterator[None]:
    """Context that lets no error out: `say` shows its message to the user; internal ones are logged with their
    traceback and reported as `what`, and errors of `say` are logged."""
    try:
        yield
        return
    except UnmixError as error:
        message = str(error)
    except Exception as error:  # noqa: BLE001 - internal errors must not end the thread that serves everyone
        _LOG.error("%s", terminal_text(f"{what}\n{traceback.format_exc()}"))
        message = f"{what}: {type(error).__name__}: {error}"
    try:
        say(message)
    except Exception:  # noqa: BLE001 - the page to tell has gone
        _LOG.warning("%s", terminal_text(f"{what}, and the client could not be told: {message}"))


class Debounced:
    """Work that waits until its events have stopped coming: browsers send every letter that is typed."""

    def __init__(self, work: Callable[[], None]) -> None:
        """`work` is done once, at a tick without events since the one before."""
        self._work = work
        self._ticks_left = 0

    @property
    def is_waiting(self) -> bool:
        """Whether there is something left to do."""
        return self._ticks_left > 0

    def note(self) -> None:
        """An event came."""
        self._ticks_left = 2

    def tick(self, at_once: bool = False) -> None:
        """Do the work if its time has come, or at once if there is any; called twice a second."""
        if self.is_waiting:
            self._ticks_left = 0 if at_once else self._ticks_left - 1
            if not self.is_waiting:
                self._work()


BLOCK_STYLE = "padding:0.2em 0.8em 0.4em;font-size:0.85em;line-height:1.35"
_ROW = '<div style="display:flex;align-items:center;gap:0.5em">'


def paragraph(text: str, is_warning: bool = False) -> str:
    """A line of text as HTML; here and below every text is escaped: names of endmembers are users' own words."""
    colour = ";color:#c92a2a" if is_warning else ""
    return f'<div style="{BLOCK_STYLE}{colour}">{escape(text)}</div>'


def bars(entries: Iterable[tuple[str, float, Sequence[float]]], interval: Interval | None = None) -> str:
    """Names, values in [0, 1] and sRGB colours as horizontal bars, the 16 largest; with their interval, if there is
    one, or why it is not determined."""
    shown = list(entries)
    ends, note = [""] * len(shown), ""
    if interval is not None:
        notes = [f"and {interval.coverage:.0%} interval"] if interval.is_known else []
        if interval.is_known:
            ends = interval.in_words("{:.2f}")
        if interval.not_determined:
            notes.append(f"interval not determined: {escape(interval.not_determined)}")
        note = "".join(f'<div style="opacity:0.7">{one}</div>' for one in notes)
    ordered = sorted(zip(shown, ends, strict=True), key=lambda pair: -pair[0][1])[:16]
    rows = (
        f'{_ROW}<span style="flex:0 0 8.5em;overflow-wrap:anywhere">{escape(name)}</span>'
        '<span style="flex:1;background:#8883;height:0.8em"><span style="display:block;height:100%;'
        f'width:{100 * min(max(value, 0.0), 1.0):.1f}%;background:{css_colour(colour)}"></span></span>'
        f'<span style="flex:0 0 2.6em;text-align:right">{value:.2f}</span>'
        + (f'<span style="flex:0 0 6.5em;text-align:right;opacity:0.7">{reach}</span>' if reach else "")
        + "</div>"
        for (name, value, colour), reach in ordered
    )
    return f'<div style="{BLOCK_STYLE}">{"".join(rows)}{note}</div>'


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Names and values side by side."""
    style = "padding-right:1em;opacity:0.7;white-space:nowrap;vertical-align:top"
    cells = "".join(
        f'<tr><td style="{style}">{escape(name)}</td><td>{escape(value)}</td></tr>' for name, value in rows
    )
    return f'<div style="{BLOCK_STYLE}"><table>{cells}</table></div>'


def swatches(entries: Sequence[tuple[str, Sequence[float]]]) -> str:
    """Names below each other, one line each, behind a square of its sRGB colour."""
    cut = "overflow:hidden;white-space:nowrap;text-overflow:ellipsis"
    items = "".join(
        f'{_ROW}<span style="flex:none;width:0.9em;height:0.9em;background:{css_colour(colour)}"></span>'
        f'<span style="{cut}" title="{escape(name)}">{escape(name)}</span></div>'
        for name, colour in entries
    )
    return f'<div style="{BLOCK_STYLE}">{items}</div>'


@dataclass(frozen=True)
class Line:
    """One line of a chart."""

    name: str
    values: Float[np.ndarray, " N"]
    colour: Sequence[float]
    """sRGB, [0, 1]."""
    is_dashed: bool = False
    is_thin: bool = False


class Chart:
    """Lines over wavelength or over anything else; hidden while it has none."""

    def __init__(self, gui: viser.GuiApi, title: str, x_label: str = "wavelength (nm)") -> None:
        self._gui, self._labels = gui, (x_label, "")
        self._handle: viser.GuiUplotHandle | None = None
        self._place = gui.add_folder(title, visible=False)

    def draw(
        self, x: Float[np.ndarray, " N"] | None = None, lines: Sequence[Line] = (), y_label: str = ""
    ) -> None:
        """Show lines over a common axis; nothing without lines or values."""
        lines = () if x is None or len(x) == 0 else lines
        self._place.visible = bool(lines)
        labels, handle = (self._labels[0], y_label), self._handle
        series: Any = [{"label": labels[0]}]
        for line in lines:
            style: dict[str, Any] = {"stroke": css_colour(line.colour), "width": 1 if line.is_thin else 2.5}
            series.append({"label": line.name, **style, **({"dash": (6, 4)} if line.is_dashed else {})})
        values = (np.nan_to_num(np.asarray(line.values, np.float64)) for line in lines)
        data = (np.asarray(x, np.float64), *values)
        # A plot keeps its axes and the number of its lines.
        if handle is not None and labels == self._labels and len(handle.series) == len(series):
            handle.data, handle.series = data, tuple(series)
            return
        if handle is not None:
            handle.remove()
        self._handle, self._labels = None, labels
        if lines:
            scales: Any = {"x": {"time": False, "auto": True}, "y": {"auto": True}}
            axes: Any = tuple({"label": label} for label in labels)
            with self._place:
                self._handle = self._gui.add_uplot(
                    data=data, series=tuple(series), scales=scales, axes=axes, aspect=1.3
                )
