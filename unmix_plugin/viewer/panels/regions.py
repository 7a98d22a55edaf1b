"""Draw a part of the picture and name it: its area, its mean spectrum with its spread, what it is made of. It is kept
with the run as `unmix-export regions` keeps regions."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import torch

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.measured_surface import MeasuredRegion, MeasuredSurface
from unmix_plugin.trained.measures import describe_area
from unmix_plugin.trained.regions import InView, Region, check_name, polygon_mask
from unmix_plugin.viewer.page import Chart, Line, bars, paragraph, reporting_failures, table, text
from unmix_plugin.viewer.panels.probe import add_click_switch
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import pose_of

_OUTLINE, _PART = "/outline", "/region"
_COLOUR = (230, 30, 90)
_SHAPES = ("box", "polygon")
_NO_REGION: tuple[str, ...] = ("none: choose one",)
"""No region can have this name."""
_OUTLINE_DEPTH = 0.1
"""Model units before the camera, where nothing hides the outline."""
_CORNER_PART, _LIFT_PX = 0.004, 1.5
"""Radius of a corner's marker, as part of that depth; pixels by which a region is shown above its surface."""
_INVITATION = "Tick the box, and click two opposite corners of a box, or the corners of a polygon."


class RegionsPanel:
    """The regions of the run, and one that a client is drawing."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._camera: Cameras | None = None
        """From which the corners were clicked."""
        self._corners: list[tuple[float, float]] = []
        """Column and row in its picture."""
        self._is_busy = False
        self._changed_at = session.services.regions.changed_at
        gui = session.client.gui
        add_click_switch(session, "draw where I click", self._take, is_on=False)
        self._shape = session.on_change(gui.add_dropdown("shape", _SHAPES), self._forget)
        self._text = gui.add_html(paragraph(_INVITATION))
        self._name = gui.add_text("region name", "")
        session.add_button("keep the region", self._keep)
        session.add_button("forget the corners", self._forget, "gray")
        self._progress = gui.add_html("")
        self._chosen = session.on_change(gui.add_dropdown("region", _NO_REGION), self._show_chosen)
        self._found, self._bars = gui.add_html(""), gui.add_html("")
        self._chart = Chart(gui, "mean spectrum")
        session.add_button("remove the region", self._remove, "gray")
        session.guarded(lambda: self._list(_NO_REGION[0]))()
        session.on_tick.append(self._follow)

    @property
    def _outline(self) -> list[tuple[float, float]]:
        if self._shape.value != _SHAPES[0] or len(self._corners) < 2:
            return self._corners
        (left, top), (right, bottom) = self._corners
        return [(left, top), (right, top), (right, bottom), (left, bottom)]

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        before = self._camera
        has_moved = before is not None and pose_of(before) != pose_of(camera)
        if has_moved or (self._shape.value == _SHAPES[0] and len(self._corners) == 2):
            self._corners = []
        self._camera = camera
        self._corners.append(place)
        self._draw()
        begun = "The view has changed, so the outline begins here. " if has_moved else ""
        self._text.content = paragraph(f"{begun}Corners: {len(self._corners)}.")

    def _draw(self) -> None:
        scene, camera = self._session.client.scene, self._camera
        scene.remove_by_name(_OUTLINE)
        self._session.show_objects("outline", bool(self._corners))
        if camera is None or not self._corners:
            return
        coords = torch.tensor(self._outline, dtype=torch.float32)
        rays = camera.generate_rays(torch.zeros(len(coords), dtype=torch.int64), coords)
        points = (rays.origins + _OUTLINE_DEPTH * rays.directions).numpy()
        for index, point in enumerate(points):
            radius = _CORNER_PART * _OUTLINE_DEPTH
            scene.add_icosphere(f"{_OUTLINE}/{index}", radius, color=_COLOUR, position=point)
        if len(points) > 1:
            edges = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
            scene.add_line_segments(
                f"{_OUTLINE}/edges", edges, _COLOUR, thickness=3.0, thickness_units="screen"
            )

    def _forget(self) -> None:
        self._camera, self._corners = None, []
        self._text.content = paragraph(_INVITATION)
        self._draw()

    def _keep(self) -> None:
        regions, camera, outline = self._session.services.regions, self._camera, self._outline
        name = check_name(text(self._name.value), regions.kept)
        if camera is None or len(outline) < 3:
            raise ConfigError("draw a region first: two corners of a box, or three or more of a polygon")
        region = InView.of_mask(camera, polygon_mask(outline, camera.size(0)))
        before = ", in place of the one before" if name in regions.kept else ""

        def keep() -> None:
            regions.keep(name, region)
            self._forget()
            self._list(name)
            self._session.say("region kept", f"{name}: kept with the run{before}")

        self._measure(name, region, keep)

    def _measure(self, name: str, region: Region, then: Callable[[], None]) -> None:
        """Measure a region in a thread of its own, since the first one takes long."""
        session, regions = self._session, self._session.services.regions
        if self._is_busy:
            raise ConfigError("a region is being measured; wait for it")
        self._is_busy = True

        def show(what: str) -> None:
            if not session.is_closed:
                self._progress.content = paragraph(f"{what} ...") if what else ""

        def work() -> None:
            with reporting_failures("the region could not be measured", session.warn):
                try:
                    regions.measure(name, region, show)
                finally:
                    self._is_busy = False
                    show("")
                session.guarded(then)()

        threading.Thread(target=work, name="unmix-viewer-region", daemon=True).start()

    def _list(self, chosen: str) -> None:
        """Show the names of what is kept, and what one of them is, if it is kept still."""
        names = (*_NO_REGION, *self._session.services.regions.kept)
        self._chosen.options = names
        self._chosen.value = chosen if chosen in names else _NO_REGION[0]
        self._show_chosen()

    def _follow(self) -> None:
        """Other pages and commands keep and remove regions and set the scale, too."""
        changed_at = self._session.services.regions.changed_at
        if changed_at != self._changed_at and not self._is_busy:
            self._changed_at = changed_at
            self._list(str(self._chosen.value))

    def _show_chosen(self) -> None:
        self._show(None)  # numbers of another region never stand under this name while it is measured
        regions, name = self._session.services.regions, str(self._chosen.value)
        region = regions.kept.get(name)
        if region is None:
            return
        found = regions.measured(region)
        if found is None:
            self._measure(name, region, self._show_chosen)
        else:
            self._show(found)

    def _show(self, found: tuple[MeasuredRegion, MeasuredSurface] | None) -> None:
        session = self._session
        session.client.scene.remove_by_name(_PART)
        session.show_objects("region", found is not None)
        if found is None:
            self._found.content = self._bars.content = ""
            self._chart.draw()
            return
        region, surface = found
        scene, materials = surface.scene, surface.scene.materials
        area = describe_area(region.area, session.services.source.scale)
        self._found.content = table([("area", area), ("of", "the run as it was trained, without edits")])
        colours = session.colours_of(materials)
        shares = zip(materials.names, region.abundances.tolist(), colours, strict=True)
        self._bars.content = bars(shares, region.probe.interval("abundances"))
        colour = [value / 255 for value in _COLOUR]
        lines = [Line("mean", region.mean, colour)]
        for name, spread in (("mean + std. dev.", region.spread), ("mean - std. dev.", -region.spread)):
            lines.append(Line(name, region.mean + spread, colour, is_dashed=True, is_thin=True))
        self._chart.draw(materials.bands.centers_nm, lines, materials.quantity)
        part = surface.mesh.select(region.faces)
        if len(part.faces):
            lifted = part.vertices + _LIFT_PX * scene.pixel_size * part.normals
            session.client.scene.add_mesh_simple(
                _PART, lifted.astype(np.float32), part.faces, color=_COLOUR, opacity=0.5, side="double"
            )

    def _remove(self) -> None:
        name = str(self._chosen.value)
        if name in _NO_REGION:
            raise ConfigError("choose the region to remove first")
        self._session.services.regions.keep(name, None)
        self._list(_NO_REGION[0])
        self._session.say("region removed", name)
