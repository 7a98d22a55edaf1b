"""Click two points: how far apart they are, and the scale of the run from how far apart they are in truth."""

from __future__ import annotations

import numpy as np

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.measures import (
    describe_length,
    describe_scale,
    keep_scale,
    require_on_surface,
    scale_between,
)
from unmix_plugin.viewer.page import number, paragraph, table
from unmix_plugin.viewer.panels.probe import Point, add_click_switch, surface_at
from unmix_plugin.viewer.session import Session

_NODE = "/measure"
_MARKER_RADIUS = 0.012
_COLOUR = (230, 30, 90)


class MeasurePanel:
    """Two points of a client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._points: list[tuple[Point, Point]] = []
        """In model space, where markers are, and in the world."""
        gui = session.client.gui
        add_click_switch(session, "measure where I click", self._take, is_on=False)
        self._text = gui.add_html("")
        session.add_button("forget the points", self._forget, "gray")
        with gui.add_folder("scale of the run"):
            self._scale = gui.add_html("")
            self._metres = gui.add_number("distance (m)", 0.0, min=0.0, step=0.0001)
            session.add_button("set scale", self._set_scale)
        self._changed_at = session.services.regions.changed_at
        session.guarded(self._show)()
        session.on_tick.append(self._follow)

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        with self._session.services.maker.locked_view(self._session.view.edit) as (_, shown):
            _, point, world = surface_at(shown, camera, place)
        self._points = [*self._points[: len(self._points) % 2], (point, world)]
        self._show()

    def _forget(self) -> None:
        self._points = []
        self._show()

    def _follow(self) -> None:
        """Other pages and commands set the scale, too."""
        if self._changed_at != (changed_at := self._session.services.regions.changed_at):
            self._changed_at = changed_at
            self._show()

    def _show(self) -> None:
        """Show points, distance and scale."""
        session, scene = self._session, self._session.client.scene
        scale = session.services.source.scale
        self._scale.content = paragraph(describe_scale(scale))
        scene.remove_by_name(_NODE)
        places = np.array([point for point, _ in self._points])
        for index, place in enumerate(places):
            scene.add_icosphere(f"{_NODE}/{index}", _MARKER_RADIUS, color=_COLOUR, position=place)
        session.show_objects("measure", bool(self._points))
        if len(self._points) < 2:
            begun = (
                "Click a second point."
                if self._points
                else "Tick the box, and click two points of the object."
            )
            self._text.content = paragraph(begun)
            return
        (_, first), (_, second) = self._points
        units = float(np.linalg.norm(second - first))
        length = describe_length(units, scale)
        more = [] if scale is None else [("in the scene", describe_length(units, None))]
        self._text.content = table([("distance", length), *more])
        scene.add_line_segments(
            f"{_NODE}/line", places[None], _COLOUR, thickness=3.0, thickness_units="screen"
        )
        scene.add_label(f"{_NODE}/length", length, position=places.mean(axis=0), anchor="bottom-center")

    def _set_scale(self) -> None:
        source = self._session.services.source
        source.require_final("set the scale")
        if len(self._points) < 2:
            raise ConfigError("click two points of the object first, then type how far apart they are")
        first, second = (world.tolist() for _, world in self._points)
        scale = scale_between(first, second, number(self._metres.value, 0.0, np.inf, fallback=0.0))
        with source.locked() as scene:
            require_on_surface(scene, first)
            require_on_surface(scene, second)
        keep_scale(source.run, scale)
        self._show()
        self._session.say("scale set", f"{scale.in_words}; kept with the run")
