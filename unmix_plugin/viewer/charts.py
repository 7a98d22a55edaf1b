"""Spectra and curves as charts in the browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.spectral.bands import Bands

if TYPE_CHECKING:
    import viser

_ASPECT = 1.5


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
        self._title, self._x_label = title, x_label
        self._handle: viser.GuiUplotHandle | None = None
        self._gui = gui
        self._place = gui.add_folder(title, visible=False)

    def draw(self, bands: Bands, lines: Sequence[Line]) -> None:
        """Show spectra."""
        self.plot(bands.centers_nm, lines)

    def plot(self, x: Float[np.ndarray, " N"], lines: Sequence[Line]) -> None:
        """Show lines over any axis."""
        if len(x) == 0 or not lines:
            self.clear()
            return
        data = (
            np.asarray(x, np.float64),
            *(np.nan_to_num(np.asarray(line.values, np.float64)) for line in lines),
        )
        series: tuple[Any, ...] = ({"label": self._x_label}, *(_series(line) for line in lines))
        if self._handle is not None and len(self._handle.series) == len(series):
            self._handle.data, self._handle.series = data, series
        else:
            self._remove()
            scales: Any = {"x": {"time": False, "auto": True}, "y": {"auto": True}}
            with self._place:
                self._handle = self._gui.add_uplot(data=data, series=series, scales=scales, aspect=_ASPECT)
        self._place.visible = True

    def clear(self) -> None:
        """Show nothing."""
        self._remove()
        self._place.visible = False

    def _remove(self) -> None:
        if self._handle is not None:
            self._handle.remove()
            self._handle = None


def _series(line: Line) -> dict[str, Any]:
    dash = {"dash": (6, 4)} if line.is_dashed else {}
    return {
        "label": line.name,
        "stroke": css_colour(line.colour),
        "width": 1 if line.is_thin else 2.5,
        **dash,
    }
