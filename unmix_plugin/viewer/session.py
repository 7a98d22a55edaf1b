"""One client: its view, panels and notices. Nothing that a client does affects another one or the server."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from unmix_plugin.trained.relighting import LightChoice
from unmix_plugin.viewer import html
from unmix_plugin.viewer.failures import failures_said
from unmix_plugin.viewer.inputs import number
from unmix_plugin.viewer.kept_pages import PageState
from unmix_plugin.viewer.layers.layer_settings import LayerSettings, first_settings
from unmix_plugin.viewer.layers.painting import ColourMapLegend
from unmix_plugin.viewer.notices import Notices
from unmix_plugin.viewer.recipe_editor import RecipeHistory
from unmix_plugin.viewer.rendering.edits import Edit
from unmix_plugin.viewer.rendering.view import DEFAULT_HEIGHT, HEIGHT_BOUNDS, Shown, View
from unmix_plugin.viewer.services import Services
from unmix_plugin.viewer.view_cameras import ViewPose, camera_of, point_ahead, pose_from, pose_of

if TYPE_CHECKING:
    import viser

    from unmix_plugin.engine.geometry.cameras import Cameras
    from unmix_plugin.spectral.materials import Materials

_MOVING_QUALITY, _RESTING_QUALITY = 80, 90
"""JPEG quality of pictures that are soon replaced, and of those that stay."""

_SMALL_PIXELS = 1 << 14
"""Pictures of so few pixels are enlarged so much that compression with loss would show; they are sent as PNG."""


@dataclass(frozen=True)
class Panel:
    """One tab of a client's controls."""

    title: str
    """Label of the tab."""
    build: Callable[[Session], object]
    """Builds the controls in the tab that is open; what follows a run or an edit registers with the session."""
    applies: Callable[[Services], bool] = lambda _: True
    """Whether clients of a viewer have it."""


class Session:
    """What the server keeps for a client from its admission to its disconnection."""

    def __init__(
        self,
        client: viser.ClientHandle,
        services: Services,
        state: PageState | None = None,
        browser: str = "",
    ) -> None:
        """
        Args:
            client: The page.
            services: What all pages share.
            state: What the page showed before it was loaded again, if it was.
            browser: The name that the page's browser keeps.
        """
        self.client = client
        self.services = services
        self.browser = browser
        self.history = RecipeHistory(services.first_recipe) if state is None else state.history
        light = LightChoice() if state is None else state.light
        self.view = View(show=self._show, report=self._report, edit=Edit(self.history.present, light))
        if state is None:
            self.view.settings = self._first_settings()
            self.view.largest_height = _first_height(client.camera.image_height)
        else:
            self.view.settings, self.view.pose = state.settings, state.pose
            self.view.largest_height, self.view.subpixels = state.largest_height, state.subpixels
        self._returns = state is not None
        self.is_closed = False
        self._lock = threading.RLock()
        self.on_tick: list[Callable[[], None]] = []
        """Called twice a second."""
        self.on_edit: list[Callable[[], None]] = []
        """Called when materials or light have changed."""
        self.on_close: list[Callable[[], None]] = []
        """Called when the client has gone."""
        self._legend: viser.GuiHtmlHandle | None = None
        self._status: viser.GuiHtmlHandle | None = None
        self._legend_shown = ""
        self.value_range_shown: tuple[float, float] | None = None
        """Ends of the colour map of the picture shown; None where it has none."""
        self._object_owners: set[str] = set()
        self._notices = Notices(client)

    def _first_settings(self) -> LayerSettings:
        if self.services.has_materials:
            return first_settings(self.materials().bands)
        layers = self.services.layers
        return LayerSettings(layer="rgb" if "rgb" in layers else next(iter(layers), "rgb"))

    def open(self, panels: Sequence[Panel]) -> None:
        """Build the panels, in the order of their tabs, and begin to render."""
        gui = self.client.gui
        self._status = gui.add_html(html.paragraph("waiting for the first picture"))
        self._legend = gui.add_html("")
        tabs = gui.add_tab_group()
        for panel in panels:
            if panel.applies(self.services):
                with tabs.add_tab(panel.title):
                    panel.build(self)
        self.services.loop.add(self.view)
        if self.is_closed:  # the client left while its panels were built
            self.services.loop.remove(self.view)
            return
        if self.services.has_materials:
            self._show_notes(self.services.maker.edited(self.view.edit).notes)
        self.client.camera.on_update(self._moved)
        if self._returns and self.view.pose is not None:
            self.services.loop.move(self.view, self.view.pose)
            self.look_from(camera_of(self.view.pose, 64))
        else:
            self._moved(self.client.camera)

    def close(self) -> None:
        """Stop rendering for the client."""
        self.is_closed = True
        self.services.loop.remove(self.view)
        for tell in self.on_close:
            tell()

    @property
    def state(self) -> PageState:
        """What the page shows, to be restored when it is loaded again."""
        view = self.view
        return PageState(
            view.pose, view.settings, self.history, view.largest_height, view.subpixels, view.edit.light
        )

    def tick(self) -> None:
        """Update what panels show of a run in progress."""
        for tell in self.on_tick:
            self.guarded(tell)()

    def guarded(self, work: Callable[[], None]) -> Callable[..., None]:
        """A callback for the browser's events: one at a time for each client, with errors shown to it."""

        def callback(_event: Any = None) -> None:
            with self._lock, failures_said("that failed", self.warn):
                if not self.is_closed:
                    work()

        return callback

    def say(self, title: str, text: str) -> None:
        """Show a notice."""
        if not self.is_closed:
            self._notices.say(title, text)

    def warn(self, text: str, title: str = "not done") -> None:
        """Show a warning in place of the one before."""
        if not self.is_closed:
            self._notices.warn(text, title)

    def _show_notes(self, notes: tuple[str, ...]) -> None:
        if not self.is_closed:
            self._notices.show_notes(notes)

    def restyle(self, settings: LayerSettings) -> None:
        """Show another layer, or the same otherwise."""
        self.services.loop.restyle(self.view, settings)

    def materials(self) -> Materials:
        """The materials as this client sees them."""
        return self.services.maker.edited(self.view.edit).materials

    def colours_of(self, materials: Materials) -> list[tuple[float, ...]]:
        """sRGB colours that stand for materials."""
        aids = self.services.aids.for_layers()
        assert aids is not None
        return [tuple(row) for row in aids.colours_of(materials).tolist()]

    def change_edit(self, edit: Edit) -> None:
        """Show the scene with other materials or light.

        Raises:
            UnmixError: the edit does not fit the run; nothing has changed.
        """
        notes = self.services.maker.edited(edit).notes
        self.services.loop.change_edit(self.view, edit)
        for tell in self.on_edit:
            tell()
        self._show_notes(notes)

    def change_light(self, light: LightChoice) -> None:
        """Show a scene whose light can be exchanged under another one."""
        self.services.loop.change_edit(self.view, Edit(self.view.edit.recipe, light))

    def show_objects(self, owner: str, has_some: bool) -> None:
        """Note whether a panel shows objects of the browser's own, which need depth to be hidden behind the picture."""
        (self._object_owners.add if has_some else self._object_owners.discard)(owner)
        self.services.loop.want_depth(self.view, bool(self._object_owners))

    def pose(self) -> ViewPose:
        """Where the client looks from now.

        Raises:
            ConfigError: its camera is invalid.
        """
        return pose_from(self.client.camera)

    def look_from(self, camera: Cameras) -> None:
        """Move the client's camera to one of ours."""
        pose = pose_of(camera)
        with self.client.atomic():
            self.client.camera.wxyz = pose.wxyz
            self.client.camera.position = pose.position
            self.client.camera.look_at = point_ahead(camera, self.services.source.record.scene_box)
            self.client.camera.fov = pose.fov

    def _moved(self, camera: viser.CameraHandle) -> None:
        """The client's camera moved; what it sends may be anything."""
        if self.is_closed:
            return
        with failures_said("the camera could not be read", self._report):
            self.services.loop.move(self.view, pose_from(camera))

    def _show(self, shown: Shown) -> None:
        if self.is_closed:
            return
        height, width = shown.picture.shape[:2]
        self.client.scene.set_background_image(
            shown.picture,
            format="png" if shown.is_labels or height * width <= _SMALL_PIXELS else "jpeg",
            jpeg_quality=_MOVING_QUALITY if shown.is_moving else _RESTING_QUALITY,
            depth=shown.depth,
        )
        if self._legend is not None:
            text = html.legend(shown.legend)
            if text != self._legend_shown:
                self._legend_shown = self._legend.content = text
            self.value_range_shown = (
                (shown.legend.low, shown.legend.high) if isinstance(shown.legend, ColourMapLegend) else None
            )
        if self._status is not None and not self.view.has_reported:
            speed = self.services.maker.speed.rays_per_second
            more = ", refining" if shown.is_moving else ""
            self._status.content = html.paragraph(f"{width} x {height}, {speed / 1000:.0f} k rays/s{more}")

    def _report(self, text: str) -> None:
        """Show in the panel what is wrong with the picture, until it is right again."""
        if self._status is not None and not self.is_closed and text:
            self._status.content = html.paragraph(text, is_warning=True)


def _first_height(canvas_rows: Any) -> int:
    """Rows of the finest picture of a new page: those of its canvas, within reason."""
    return int(number(canvas_rows, DEFAULT_HEIGHT, HEIGHT_BOUNDS[1], fallback=DEFAULT_HEIGHT)) // 16 * 16
