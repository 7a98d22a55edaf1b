"""Click a point: its spectrum, what it is made of, and what training views measured there; several are compared.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import csv_bytes, write_file
from unmix_plugin.scenes.folder import METRES_KEY
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.trained.measures import Scale
from unmix_plugin.trained.protocol import Probe, RenderableScene
from unmix_plugin.viewer.page import Chart, Line, bars, new_file, number, paragraph, table
from unmix_plugin.viewer.panels.materials import likeness_rows
from unmix_plugin.viewer.rendering.pictures import PictureMaker
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import camera_of

if TYPE_CHECKING:
    import viser

Point = Float64[np.ndarray, "3"]


def surface_at(
    scene: RenderableScene, camera: Cameras, place: tuple[float, float]
) -> tuple[Probe, Point, Point]:
    """What is seen at a place (column, row) of a picture, and where that is in model space and in the world; a
    ConfigError where nothing is."""
    found = scene.probe(camera, int(place[0]), int(place[1]))
    if found.opacity < OCCUPIED_ACCUMULATION or found.position is None or found.world_position is None:
        raise ConfigError("nothing is there: less than half of the light ends on something")
    return found, found.position, found.world_position


@dataclass(frozen=True)
class ProbedPoint:
    """What one point is made of."""

    number: int
    """From 1."""
    found: Probe
    point: Point
    """Model space."""
    world: Point
    """The same point in the world that exports are in."""
    materials: Materials
    """As they are shown."""
    measured: Float64[np.ndarray, " B"] | None = None
    """Mean radiance in the training views that see the point."""
    measured_in: str = ""
    """How many views that are, or the name of the only one."""

    @property
    def predicted(self) -> Float64[np.ndarray, " B"]:
        """Radiance, as rendered."""
        return self.found.values["predicted"]

    @property
    def material(self) -> str:
        """Its name, chosen as in segmentations."""
        return self.materials.name_of(self.predicted, self.found.abundances)

    @property
    def label(self) -> str:
        """How menus have it."""
        return f"{self.number}: {self.material}"

    @property
    def colour(self) -> tuple[float, float, float]:
        """sRGB."""
        return _COLOURS[(self.number - 1) % len(_COLOURS)]


def take_probe(
    maker: PictureMaker, edit: Edit, camera: Cameras, place: tuple[float, float], number: int
) -> ProbedPoint:
    """What is seen at a place of a picture, and what training views measured there."""
    views = maker.aids.measured
    with maker.locked_edit(edit) as (_, shown):
        seen = surface_at(shown, camera, place)
        pixels = () if isinstance(views, str) else views.measured.pixels_that_see(seen[1], shown)
    measured = None if isinstance(views, str) else views.measured.spectra(pixels, shown)
    if measured is None:
        return ProbedPoint(number, *seen, shown.materials)
    who = measured.views[0] if len(measured.views) == 1 else f"{len(measured.views)} training views, mean"
    who = f"{who}, before the edits" if edit.recipe.operations else who
    return ProbedPoint(number, *seen, shown.materials, measured.mean, who)


def spectra_csv(probes: Sequence[ProbedPoint]) -> bytes:
    """One row a band: wavelength, and for each probe what was predicted and, where known, measured."""
    columns = {"wavelength": probes[0].materials.bands.centers_nm}
    for one in probes:
        columns[f"probe_{one.number}_predicted"] = one.predicted
        if one.measured is not None:
            columns[f"probe_{one.number}_measured"] = one.measured
    rows = np.stack([*columns.values()], axis=1)
    return csv_bytes([[*columns], *([f"{value:.9g}" for value in row] for row in rows)])


def abundances_csv(probes: Sequence[ProbedPoint], scale: Scale | None = None) -> bytes:
    """One row a probe: number, position in the world, metres in a unit of it (empty where unknown), material, the
    training views measured in, what the spectra are, the light lit in place of the recorded one, abundances, each with
    the ends of its 90 % interval, empty where that is not determined."""
    metres = "" if scale is None else f"{scale.metres_per_unit:.9g}"
    header = ["probe", "x", "y", "z", METRES_KEY, "material", "measured_in", "quantity", "light"]
    names = dict.fromkeys(name for one in probes for name in one.materials.names)  # renamed between probes
    rows = [[*header, *(f"{name}{end}" for name in names for end in ("", "_low", "_high"))]]
    for one in probes:
        place = [str(one.number), *(f"{value:.9g}" for value in one.world), metres]
        what = [one.material, one.measured_in, one.materials.quantity, one.materials.light_name or ""]
        interval = one.found.interval("abundances")
        numbers = np.stack([one.found.abundances, interval.low, interval.high], axis=1)
        shares = dict(zip(one.materials.names, numbers, strict=True))
        own = np.concatenate([shares.get(name, np.full(3, np.nan)) for name in names])
        rows.append([*place, *what, *(f"{number:.6g}" if np.isfinite(number) else "" for number in own)])
    return csv_bytes(rows)


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
_MEASURED_COLOUR = (0.35, 0.35, 0.35)
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
        self._probes: list[ProbedPoint] = []
        self._markers: dict[int, viser.IcosphereHandle] = {}
        self._taken = 0
        gui = session.client.gui
        add_click_switch(session, "probe where I click", self._take)
        self._chosen = session.on_change(gui.add_dropdown("probe", _NO_PROBES), self._show_chosen)
        self._text = gui.add_html(paragraph(_INVITATION))
        self._bars = gui.add_html("")
        self._chart, self._comparison = Chart(gui, "spectrum"), Chart(gui, "all probes")
        session.add_button("save as CSV", self._save)
        session.add_button("forget all", self._forget, "gray")

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        session = self._session
        taken = take_probe(session.services.maker, session.view.edit, camera, place, self._taken + 1)
        self._taken += 1
        self._probes.append(taken)
        while len(self._probes) > _MOST_PROBES:
            self._drop(self._probes[0])
        red, green, blue = (int(255 * value) for value in taken.colour)
        self._markers[taken.number] = session.client.scene.add_icosphere(
            f"/probes/{taken.number}", _MARKER_RADIUS, color=(red, green, blue), position=taken.point
        )
        session.show_objects("probe", True)
        self._chosen.options = tuple(one.label for one in self._probes)
        self._chosen.value = taken.label  # which shows it

    def _show_chosen(self) -> None:
        shown = next((one for one in self._probes if one.label == self._chosen.value), None)
        if shown is None:
            return
        materials, abundances = shown.materials, shown.found.abundances
        self._text.content = table(
            [
                ("material", shown.material),
                ("position", ", ".join(f"{value:.4g}" for value in shown.world)),
                ("measured in", shown.measured_in or "no training view at hand measured the point"),
                *likeness_rows(self._session.services.library, shown.predicted, materials),
            ]
        )
        colours = self._session.colours_of(materials)
        interval = shown.found.interval("abundances")
        self._bars.content = bars(zip(materials.names, abundances.tolist(), colours, strict=True), interval)
        lines = [Line("predicted", shown.predicted, shown.colour)]
        if shown.measured is not None:
            name = f"measured, {shown.measured_in}"
            lines.append(Line(name, shown.measured, _MEASURED_COLOUR, is_dashed=True))
        brightness = shown.found.values["scaled_abundances"]
        for index in np.flatnonzero(abundances >= _SHOWN_SHARE):
            added = brightness[index] * materials.endmembers[index].double().cpu().numpy()
            lines.append(Line(materials.names[index], added, colours[index], is_thin=True))
        self._chart.draw(materials.bands.centers_nm, lines, materials.quantity)
        # Probes keep the light in which they were taken.
        quantities = " or ".join(sorted({one.materials.quantity for one in self._probes}))
        every = [Line(f"probe {one.number}", one.predicted, one.colour) for one in self._probes]
        self._comparison.draw(materials.bands.centers_nm, every, quantities)

    def _save(self) -> None:
        if not self._probes:
            raise ConfigError("there is no probe to save; click a point of the picture first")
        folder = self._session.services.folder
        for name, content in (
            ("probes", spectra_csv(self._probes)),
            ("probe-abundances", abundances_csv(self._probes, self._session.services.source.scale)),
        ):
            path = write_file(new_file(folder, name, ".csv", name), content)
            self._session.client.send_file_download(path.name, content)
        self._session.say("saved", f"spectra and abundances of the probes in {folder}")

    def _forget(self) -> None:
        for one in list(self._probes):
            self._drop(one)
        self._session.show_objects("probe", False)
        self._chosen.options = _NO_PROBES
        self._text.content, self._bars.content = paragraph(_INVITATION), ""
        self._chart.draw()
        self._comparison.draw()

    def _drop(self, one: ProbedPoint) -> None:
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

    session.on_change(switch, untick_others)
    session.client.scene.on_click()(lambda event: session.guarded(lambda: clicked(*event.screen_pos))())


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
        session.on_edit.append(self._forget)

    def _forget(self) -> None:
        self._text.content = paragraph(f"The light has changed. {_INVITATION}")

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        with self._session.services.maker.locked_view(self._session.view.edit) as (_, shown):
            found = shown.probe(camera, int(place[0]), int(place[1]))
        rows = [(name, _first_numbers(values)) for name, values in found.values.items()]
        if found.world_position is not None:
            rows.append(("position", ", ".join(f"{value:.3f}" for value in found.world_position)))
        self._text.content = table(rows)
