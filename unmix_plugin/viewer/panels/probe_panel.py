"""Click a point: its spectrum, what it is made of, and what training views measured there; several are compared."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import write_file
from unmix_plugin.viewer import html
from unmix_plugin.viewer.charts import Chart, Line
from unmix_plugin.viewer.inputs import new_file, number
from unmix_plugin.viewer.likeness import likeness_rows
from unmix_plugin.viewer.probing import ProbedPoint, abundances_csv, spectra_csv
from unmix_plugin.viewer.scene_objects import add_probe
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import camera_of

if TYPE_CHECKING:
    import viser

MOST_PROBES = 12
"""Probes that a client keeps; the first goes when another comes."""

_COLOURS = (
    (0.9, 0.1, 0.3),
    (0.1, 0.45, 0.9),
    (0.1, 0.6, 0.2),
    (0.85, 0.5, 0.0),
    (0.5, 0.2, 0.8),
    (0.0, 0.6, 0.6),
)
_SHOWN_SHARE = 0.08
"""Endmembers of at least this share: what they add to a probe's spectrum is drawn beside it."""

_PROBED_ROWS = 512
_NONE = "none yet"


class ProbePanel:
    """Keeps the probes of a client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._probes: list[ProbedPoint] = []
        self._markers: dict[int, viser.IcosphereHandle] = {}
        self._taken = 0
        gui = session.client.gui
        self._is_on = gui.add_checkbox("probe where I click", True)
        self._chosen = gui.add_dropdown("probe", _no_probes())
        self._chosen.on_update(session.guarded(self._show_chosen))
        self._text = gui.add_html(html.paragraph("Click a point of the picture."))
        self._bars = gui.add_html("")
        self._chart = Chart(gui, "spectrum")
        self._comparison = Chart(gui, "all probes")
        gui.add_button("save as CSV").on_click(session.guarded(self._save))
        gui.add_button("forget all").on_click(session.guarded(self._forget))
        session.client.scene.on_click()(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        x, y = event.screen_pos
        self._session.guarded(lambda: self._take(x, y))()

    def _take(self, x: Any, y: Any) -> None:
        """Probe a point of the canvas, given in parts of its width and height."""
        if self._is_on.value is not True:
            return
        column, row = (number(value, 0.0, 1.0, fallback=0.5) for value in (x, y))
        session, services = self._session, self._session.services
        camera = camera_of(session.pose(), _PROBED_ROWS)
        place = (column * camera.width, row * camera.height)
        taken = services.maker.probe(
            session.view.edit, camera, place, self._taken + 1, services.aids.measured
        )
        self._taken += 1
        self._probes.append(taken)
        while len(self._probes) > MOST_PROBES:
            self._drop(self._probes[0])
        self._markers[taken.number] = add_probe(session.client, taken.number, taken.point, _marker(taken))
        session.show_objects("probe", True)
        self._chosen.options = tuple(_label(one) for one in self._probes)
        self._chosen.value = _label(taken)  # which shows it

    def _show_chosen(self) -> None:
        chosen = next((one for one in self._probes if _label(one) == self._chosen.value), None)
        if chosen is not None:
            self._show(chosen)

    def _show(self, shown: ProbedPoint) -> None:
        rows = [
            ("material", shown.name),
            ("position", ", ".join(f"{value:.3f}" for value in shown.point)),
            ("measured in", shown.measured_in or "no training view at hand sees the point"),
            *likeness_rows(shown.predicted, shown.materials),
        ]
        self._text.content = html.table(rows)
        names, bands = shown.materials.names, shown.materials.bands
        colours = self._session.colours_of(shown.materials)
        entries = zip(names, shown.abundances.tolist(), colours, strict=True)
        self._bars.content = html.bars(sorted(entries, key=lambda entry: -entry[1])[:16])
        lines = [Line("predicted", shown.predicted, _colour(shown))]
        if shown.measured is not None:
            lines.append(
                Line(f"measured, {shown.measured_in}", shown.measured, (0.35, 0.35, 0.35), is_dashed=True)
            )
        lines += [
            Line(names[index], shown.contributions[index], colours[index], is_thin=True)
            for index in np.flatnonzero(shown.abundances >= _SHOWN_SHARE)
        ]
        self._chart.draw(bands, lines)
        self._comparison.draw(
            bands, [Line(f"probe {one.number}", one.predicted, _colour(one)) for one in self._probes]
        )

    def _save(self) -> None:
        if not self._probes:
            raise ConfigError("there is no probe to save; click a point of the picture first")
        folder = self._session.services.folder
        for name, content in (
            ("probes", spectra_csv(self._probes)),
            ("probe-abundances", abundances_csv(self._probes)),
        ):
            path = write_file(new_file(folder, name, ".csv", name), content)
            self._session.client.send_file_download(path.name, content)
        self._session.say("saved", f"{path.parent}: spectra and abundances of {len(self._probes)} probes")

    def _forget(self) -> None:
        for one in list(self._probes):
            self._drop(one)
        self._session.show_objects("probe", False)
        self._chosen.options = _no_probes()
        self._text.content, self._bars.content = html.paragraph("Click a point of the picture."), ""
        self._chart.clear()
        self._comparison.clear()

    def _drop(self, one: ProbedPoint) -> None:
        self._probes.remove(one)
        self._markers.pop(one.number).remove()


def _label(one: ProbedPoint) -> str:
    return f"{one.number}: {one.name}"


def _colour(one: ProbedPoint) -> tuple[float, float, float]:
    return _COLOURS[(one.number - 1) % len(_COLOURS)]


def _marker(one: ProbedPoint) -> tuple[int, int, int]:
    red, green, blue = (int(255 * value) for value in _colour(one))
    return red, green, blue


def _no_probes() -> tuple[str, ...]:
    return (_NONE,)
