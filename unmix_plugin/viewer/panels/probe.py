"""Click a point: its spectrum, what it is made of, and what training views measured there; several are compared.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import csv_bytes, write_file
from unmix_plugin.scenes.placement import METRES_KEY
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.page import Chart, Line, bars, new_file, number, paragraph, table
from unmix_plugin.viewer.panels.materials import likeness_rows
from unmix_plugin.viewer.rendering.pictures import PictureMaker
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import camera_of

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class _ProbedPoint:
    """What one point is made of."""

    number: int
    """From 1."""
    point: tuple[float, float, float]
    """Model space."""
    world: tuple[float, float, float]
    """The same point in the world that exports are in."""
    materials: Materials
    """As they are shown."""
    predicted: Float64[np.ndarray, " B"]
    """Radiance, as rendered."""
    abundances: Float64[np.ndarray, " K"]
    """Shares, sum 1."""
    contributions: Float64[np.ndarray, "K B"]
    """Radiance that each endmember adds, as bright as it is there."""
    measured: Float64[np.ndarray, " B"] | None = None
    """Radiance in a training view that sees the point."""
    measured_in: str = ""
    """Name of that view."""

    @property
    def name(self) -> str:
        """Of its material, chosen as in segmentations."""
        return self.materials.name_of(self.predicted, self.abundances)


def _probe_through(
    scene: TrainedScene, camera: Cameras, column: float, row: float, number: int
) -> _ProbedPoint:
    """What is seen through a point of a picture, given in pixels; a ConfigError where nothing is there."""
    pixel = min(max(int(column), 0), camera.width - 1), min(max(int(row), 0), camera.height - 1)
    found = scene.probe(camera, *pixel)
    if found.opacity < OCCUPIED_ACCUMULATION or found.position is None or found.world_position is None:
        raise ConfigError("nothing is there to probe: less than half of the light ends on something")
    x, y, z = found.position.tolist()
    world_x, world_y, world_z = found.world_position.tolist()
    endmembers = scene.materials.endmembers.double().cpu().numpy()
    return _ProbedPoint(
        number,
        (x, y, z),
        (world_x, world_y, world_z),
        scene.materials,
        found.values["predicted"],
        found.values["abundances"],
        found.values["scaled_abundances"][:, None] * endmembers,
    )


def _take_probe(
    maker: PictureMaker, edit: Edit, camera: Cameras, place: tuple[float, float], number: int
) -> _ProbedPoint:
    """What is seen through a point (column, row) of a picture, and what a training view measured there."""
    with maker.edit_turn(edit) as (scene, shown):
        taken = _probe_through(shown, camera, *place, number)
        measured, point = maker.aids.measured, torch.tensor(taken.point)
        found = measured and measured.measurement(point, camera, shown.light_power, scene)
    if found is None:
        return taken
    view, spectrum = found
    view = f"{view}, before the edits" if edit.recipe.operations else view
    return replace(taken, measured=spectrum.double().numpy(), measured_in=view)


def _spectra_csv(probes: Sequence[_ProbedPoint]) -> bytes:
    """One row a band: wavelength, and for each probe what was predicted and, where known, measured."""
    header, columns = ["wavelength"], [probes[0].materials.bands.centers_nm]
    for one in probes:
        header.append(f"probe_{one.number}_predicted")
        columns.append(one.predicted)
        if one.measured is not None:
            header.append(f"probe_{one.number}_measured")
            columns.append(one.measured)
    return csv_bytes([header, *([f"{value:.9g}" for value in row] for row in np.stack(columns, axis=1))])


def _abundances_csv(probes: Sequence[_ProbedPoint], scale: Scale | None = None) -> bytes:
    """One row a probe: number, position in the world, metres in a unit of it (empty where unknown), material, the
    training view measured in, what the spectra are, the light lit in place of the recorded one, abundances."""
    metres = "" if scale is None else f"{scale.metres_per_unit:.9g}"
    header = ["probe", "x", "y", "z", METRES_KEY, "material", "measured_in", "quantity", "light"]
    header += probes[0].materials.names
    rows = [
        [
            str(one.number),
            *(f"{value:.9g}" for value in one.world),
            metres,
            one.name,
            one.measured_in,
            one.materials.quantity,
            one.materials.light_name or "",
            *(f"{value:.6g}" for value in one.abundances),
        ]
        for one in probes
    ]
    return csv_bytes([header, *rows])


_MOST_PROBES = 12
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
_MARKER_RADIUS = 0.015
_NO_PROBES: tuple[str, ...] = ("none yet",)
_INVITATION = "Click a point of the picture."


class ProbePanel:
    """Keeps the probes of a client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._probes: list[_ProbedPoint] = []
        self._markers: dict[int, viser.IcosphereHandle] = {}
        self._taken = 0
        gui = session.client.gui
        add_click_switch(session, "probe where I click", self._take)
        self._chosen = gui.add_dropdown("probe", _NO_PROBES)
        self._chosen.on_update(session.guarded(self._show_chosen))
        self._text = gui.add_html(paragraph(_INVITATION))
        self._bars = gui.add_html("")
        quantity = session.materials().quantity
        self._chart, self._comparison = (Chart(gui, title, quantity) for title in ("spectrum", "all probes"))
        session.add_button("save as CSV", self._save)
        session.add_button("forget all", self._forget, is_minor=True)

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        session, services = self._session, self._session.services
        taken = _take_probe(services.maker, session.view.edit, camera, place, self._taken + 1)
        self._taken += 1
        self._probes.append(taken)
        while len(self._probes) > _MOST_PROBES:
            self._drop(self._probes[0])
        red, green, blue = (int(255 * value) for value in _colour(taken))
        self._markers[taken.number] = session.client.scene.add_icosphere(
            f"/probes/{taken.number}", _MARKER_RADIUS, color=(red, green, blue), position=taken.point
        )
        session.show_objects("probe", True)
        self._chosen.options = tuple(_label(one) for one in self._probes)
        self._chosen.value = _label(taken)  # which shows it

    def _show_chosen(self) -> None:
        shown = next((one for one in self._probes if _label(one) == self._chosen.value), None)
        if shown is None:
            return
        self._text.content = table(
            [
                ("material", shown.name),
                ("position", ", ".join(f"{value:.4g}" for value in shown.world)),
                ("measured in", shown.measured_in or "no training view at hand measured the point"),
                *likeness_rows(self._session.services.library, shown.predicted, shown.materials),
            ]
        )
        names, wavelengths = shown.materials.names, shown.materials.bands.centers_nm
        colours = self._session.colours_of(shown.materials)
        entries = zip(names, shown.abundances.tolist(), colours, strict=True)
        self._bars.content = bars(entries)
        lines = [Line("predicted", shown.predicted, _colour(shown))]
        if shown.measured is not None:
            grey = (0.35, 0.35, 0.35)
            lines.append(Line(f"measured, {shown.measured_in}", shown.measured, grey, is_dashed=True))
        lines += [
            Line(names[index], shown.contributions[index], colours[index], is_thin=True)
            for index in np.flatnonzero(shown.abundances >= _SHOWN_SHARE)
        ]
        self._chart.draw(wavelengths, lines, shown.materials.quantity)
        # Probes keep the light in which they were taken.
        quantities = " or ".join(sorted({one.materials.quantity for one in self._probes}))
        every = [Line(f"probe {one.number}", one.predicted, _colour(one)) for one in self._probes]
        self._comparison.draw(wavelengths, every, quantities)

    def _save(self) -> None:
        if not self._probes:
            raise ConfigError("there is no probe to save; click a point of the picture first")
        folder = self._session.services.folder
        for name, content in (
            ("probes", _spectra_csv(self._probes)),
            ("probe-abundances", _abundances_csv(self._probes, self._session.services.source.scale)),
        ):
            path = write_file(new_file(folder, name, ".csv", name), content)
            self._session.client.send_file_download(path.name, content)
        self._session.say("saved", f"{folder}: spectra and abundances of {len(self._probes)} probes")

    def _forget(self) -> None:
        for one in list(self._probes):
            self._drop(one)
        self._session.show_objects("probe", False)
        self._chosen.options = _NO_PROBES
        self._text.content, self._bars.content = paragraph(_INVITATION), ""
        for chart in (self._chart, self._comparison):
            chart.draw(np.zeros(0), ())

    def _drop(self, one: _ProbedPoint) -> None:
        self._probes.remove(one)
        self._markers.pop(one.number).remove()


def add_click_switch(
    session: Session, label: str, work: Callable[[Cameras, tuple[float, float]], None], is_on: bool = True
) -> None:
    """A box that, while ticked, has something done at each click, with the camera of the canvas and the column and row
    that were clicked; ticking it unticks those of other panels."""
    switch = session.client.gui.add_checkbox(label, is_on)
    session.click_switches.append(switch)

    def untick_others() -> None:
        for other in session.click_switches if switch.value is True else ():
            other.value = other is switch

    def clicked(*place: Any) -> None:
        if switch.value is not True:
            return
        camera = camera_of(session.pose(), _PROBED_ROWS)
        x, y = (number(value, 0.0, 1.0, fallback=0.5) for value in place)
        work(camera, (min(x * camera.width, camera.width - 1), min(y * camera.height, camera.height - 1)))

    switch.on_update(session.guarded(untick_others))
    session.client.scene.on_click()(lambda event: session.guarded(lambda: clicked(*event.screen_pos))())


def _label(one: _ProbedPoint) -> str:
    return f"{one.number}: {one.name}"


def _colour(one: _ProbedPoint) -> tuple[float, float, float]:
    return _COLOURS[(one.number - 1) % len(_COLOURS)]


_MOST_NUMBERS = 8


def _first_numbers(values: Float64[np.ndarray, " N"]) -> str:
    """The first `_MOST_NUMBERS`, and how many there are if there are more."""
    more = f", ... ({len(values)} numbers)" if len(values) > _MOST_NUMBERS else ""
    return ", ".join(f"{value:.4g}" for value in values[:_MOST_NUMBERS]) + more


class ValuesPanel:
    """The numbers of the outputs of a scene without endmembers at the point that was clicked last."""

    def __init__(self, session: Session) -> None:
        self._session = session
        add_click_switch(session, "probe where I click", self._take)
        self._text = session.client.gui.add_html(paragraph(_INVITATION))

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        column, row = place
        with self._session.services.maker.shown_turn(self._session.view.edit) as (_, shown):
            found = shown.probe(camera, int(column), int(row))
        rows = [(name, _first_numbers(values)) for name, values in found.values.items()]
        if found.world_position is not None:
            rows.append(("position", ", ".join(f"{value:.3f}" for value in found.world_position)))
        self._text.content = table(rows)
