"""Click two points: how far apart they are, and the scale of the run from how far apart they are in truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.measures import (
    describe_length,
    describe_scale,
    keep_scale,
    require_on_surface,
    scale_between,
)
from unmix_plugin.viewer.page import number, paragraph, table
from unmix_plugin.viewer.panels.probe import add_click_switch
from unmix_plugin.viewer.session import Session

_NODE = "/measure"
_MARKER_RADIUS = 0.012
_COLOUR = (230, 30, 90)


class MeasurePanel:
    """Two points of a client."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._places: list[Float64[np.ndarray, "3"]] = []
        """Where markers are: model space."""
        self._points: list[Float64[np.ndarray, "3"]] = []
        """The same in the world."""
        gui = session.client.gui
        add_click_switch(session, "measure where I click", self._take, is_on=False)
        self._text = gui.add_html("")
        session.add_button("forget the points", self._forget, is_minor=True)
        with gui.add_folder("scale of the run"):
            self._scale = gui.add_html("")
            self._metres = gui.add_number("distance (m)", 0.0, min=0.0, step=0.0001)
            session.add_button("set scale", self._set_scale)
        session.guarded(self._show)()

    def _take(self, camera: Cameras, place: tuple[float, float]) -> None:
        services = self._session.services
        with services.maker.shown_turn(self._session.view.edit) as (_, shown):
            found = shown.probe(camera, int(place[0]), int(place[1]))
        if found.opacity < OCCUPIED_ACCUMULATION or found.position is None or found.world_position is None:
            raise ConfigError("nothing is there to measure: less than half of the light ends on something")
        if len(self._points) == 2:
            self._places, self._points = [], []
        self._places.append(found.position)
        self._points.append(found.world_position)
        self._show()

    def _forget(self) -> None:
        self._places, self._points = [], []
        self._show()

    def _show(self) -> None:
        """Show points, distance and scale; the scale is read anew, as other pages and commands set it too."""
        session, scene = self._session, self._session.client.scene
        scale = session.services.source.scale
        self._scale.content = paragraph(describe_scale(scale))
        scene.remove_by_name(_NODE)
        for index, place in enumerate(self._places):
            scene.add_icosphere(f"{_NODE}/{index}", _MARKER_RADIUS, color=_COLOUR, position=place)
        session.show_objects("measure", bool(self._places))
        if len(self._points) < 2:
            self._text.content = paragraph(
                "Click a second point."
                if self._points
                else "Tick the box, and click two points of the object."
            )
            return
        units = float(np.linalg.norm(self._points[1] - self._points[0]))
        length = describe_length(units, scale)
        rows = [("distance", length)]
        if scale is not None:
            rows.append(("in the scene", describe_length(units, None)))
        self._text.content = table(rows)
        ends = np.stack(self._places)[None]
        scene.add_line_segments(f"{_NODE}/line", ends, _COLOUR, thickness=3.0, thickness_units="screen")
        scene.add_label(f"{_NODE}/length", length, position=ends[0].mean(axis=0), anchor="bottom-center")

    def _set_scale(self) -> None:
        source = self._session.services.source
        source.require_final("set the scale")
        if len(self._points) < 2:
            raise ConfigError("click two points of the object first, then type how far apart they are")
        first, second = (point.tolist() for point in self._points)
        scale = scale_between(first, second, number(self._metres.value, 0.0, np.inf, fallback=0.0))
        with source.borrowed() as scene:
            require_on_surface(scene, first)
            require_on_surface(scene, second)
        keep_scale(source.run, scale)
        self._show()
        self._session.say("scale set", f"{scale.said}; kept with the run")
