"""What all pages of a viewer share, what each one has, and what a page leaves behind for when it is loaded again."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from unmix_plugin.editing import Light, Recipe
from unmix_plugin.editing.apply import relighting_factors
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.training.progress import TrainingStatus
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.figures.paint import ColourScale
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.colour.conversion import illuminant_names
from unmix_plugin.spectral.library.material_library import MaterialLibrary, measured_library
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.model_scene import LightChoice, lights_of, relit
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import recorded_views
from unmix_plugin.viewer.page import number, paragraph, reporting_failures
from unmix_plugin.viewer.recipes import RecipeHistory, numbered
from unmix_plugin.viewer.rendering.captures import VideoQueue
from unmix_plugin.viewer.rendering.painting import legend_html
from unmix_plugin.viewer.rendering.pictures import DEFAULT_HEIGHT, HEIGHT_BOUNDS, Picture, PictureMaker
from unmix_plugin.viewer.rendering.regions import RunRegions
from unmix_plugin.viewer.rendering.render_loop import RenderLoop, View
from unmix_plugin.viewer.rendering.scene import Edit, MeasuredViews, SceneSource
from unmix_plugin.viewer.rendering.settings import LayerSettings, first_settings
from unmix_plugin.viewer.rendering.thumbnails import Thumbnails
from unmix_plugin.viewer.view_cameras import ViewPose, camera_of, point_ahead, pose_from, pose_of

if TYPE_CHECKING:
    import viser

_MOST_POINTS = 400
"""Of the curves of a training."""


class Services:
    """Shared by the sessions of all clients."""

    def __init__(
        self,
        source: SceneSource,
        read_scene: Callable[[], Scene],
        recipe: Recipe | None = None,
        environments: Sequence[Path] = (),
        library: MaterialLibrary | None = None,
    ) -> None:
        """Computes nothing yet; the scene is read beside everything else once `start` is called.

        Args:
            source: The model.
            read_scene: Reads the scene that a run was trained on; an UnmixError if it is not at hand.
            recipe: What every client sees the scene with at first; a ConfigError if it does not fit the run.
            environments: Files of lights to offer beside those of the scene; an UnmixError if one is unusable.
            library: Known materials; None: the built-in ones.
        """
        self.source, self._library = source, library
        self.views = recorded_views(source.record)
        self.thumbnails: Thumbnails | None = None
        """The views of the scene in few pixels, once the scene is read."""
        self.folder = source.run.exports / "viewer"
        """Where files go that clients ask for: in the run folder, and nowhere else."""
        self.recipes_folder = source.run.path / "recipes"
        self.videos = VideoQueue()
        self.curve: list[TrainingStatus] = []
        """How training went, evenly over its steps."""
        self._curve_step = 1
        self._read_scene = read_scene
        self._reader = threading.Thread(target=self._read, name="unmix-viewer-scene", daemon=True)
        paths = tuple(str(path.resolve()) for path in environments)
        with source.locked() as scene:
            for path in paths:
                relit(scene, LightChoice(path), "of this run")
            self.has_materials = scene.materials is not None
            self.lights: tuple[str, ...] = (*lights_of(scene), *paths)
            """Names of the scene's lights, and the paths of those that a user gives."""
        self.maker = PictureMaker(source)
        self.regions = RunRegions(self.maker)
        self.loop = RenderLoop(self.maker)
        self.first_recipe = Recipe()
        """Every client's first recipe; endmembers are given by their numbers."""
        if recipe is not None:
            self.first_recipe = numbered(recipe, self.maker.edited(Edit()).materials.names)
            self.maker.edited(Edit(self.first_recipe))

    @property
    def library(self) -> MaterialLibrary:
        """Known materials that spectra are compared with."""
        return measured_library() if self._library is None else self._library

    @cached_property
    def usable_lights(self) -> tuple[str, ...]:
        """Names of the lights that the scene can be shown in."""
        scene, names = self.maker.edited(Edit()), []
        for name in illuminant_names():
            with suppress(SpectrumError):
                relighting_factors(scene.bands, scene.light_power, Light(name))
                names.append(name)
        return tuple(names)

    def start(self) -> None:
        """Begin to render, and to read the scene."""
        self.loop.start()
        self._reader.start()

    def tick(self) -> None:
        """Note how training goes; called twice a second."""
        status = None if self.source.control is None else self.source.control.status
        if status is None or (self.curve and status.step < self.curve[-1].step + self._curve_step):
            return
        curve = [*self.curve, status]
        if len(curve) > _MOST_POINTS:
            curve, self._curve_step = curve[::2], 2 * (status.step - curve[0].step) // _MOST_POINTS
        self.curve = curve  # another one each time: panels read it meanwhile

    def stop(self) -> None:
        """End rendering and measuring; waits for the scene if it is still being read."""
        self.videos.stop()
        self.regions.stop()
        self.loop.stop()
        # Not left behind: a thread in native code when the interpreter ends takes the process down with it.
        self.wait_for_scene()

    def wait_for_scene(self, timeout_s: float | None = None) -> None:
        """Wait until the scene is read, if it is being read."""
        if self._reader.is_alive():
            self._reader.join(timeout_s)

    def _read(self) -> None:
        """Read the scene; without it the viewer only lacks what was measured."""
        if self.has_materials:
            _ = self.usable_lights  # takes a second, which the first page need not wait for
        aids = self.maker.aids

        def give_up(reason: str) -> None:
            aids.measured = f"the scene is not at hand: {reason}"

        with reporting_failures("the scene could not be read", give_up):
            scene = self._read_scene()
            self.thumbnails = Thumbnails(scene)
            if self.has_materials:
                views = MeasuredViews(scene, self.source)
                has_some = bool(views.measured.usable_views)
                aids.measured = views if has_some else "no training view has all bands"


@dataclass(frozen=True)
class PageState:
    """What a page shows, and the edits that it may go back to."""

    settings: LayerSettings
    history: RecipeHistory
    largest_height: int
    subpixels: int = 1
    pose: ViewPose | None = None
    light: LightChoice = LightChoice()


_MOVING_QUALITY, _RESTING_QUALITY = 80, 90
"""JPEG quality of pictures that are soon replaced, and of those that stay."""

_NOTICE_S = 8.0
_LONGEST_NOTICE = 2000
"""Characters."""

_SMALL_PIXELS = 1 << 14
"""Pictures of so few pixels are enlarged so much that compression with loss would show; they are sent as PNG."""

_ControlT = TypeVar("_ControlT")


class Session:
    """One client, from its admission to its disconnection; nothing that it does affects another one or the server."""

    def __init__(
        self,
        client: viser.ClientHandle,
        services: Services,
        state: PageState | None = None,
        browser: str = "",
    ) -> None:
        """`state` is what the page showed before it was loaded again, if it was; `browser` names its browser."""
        self.client, self.services, self.browser = client, services, browser
        state = self._first_state() if state is None else state
        self.history = state.history
        edit = Edit(state.history.present, state.light)
        sizes = (state.largest_height, state.subpixels)
        self.view = View(self._show, self._report, state.settings, edit, *sizes, pose=state.pose)
        self.is_closed = self.is_filling = False
        """The latter while controls are set to what is in force, which is no change of a user's."""
        self._lock = threading.RLock()
        self.on_tick: list[Callable[[], None]] = []
        """Called twice a second."""
        self.on_edit: list[Callable[[], None]] = []
        """Called when materials or light have changed."""
        self.on_close: list[Callable[[], None]] = []
        """Called when the client has gone."""
        self.click_switches: list[viser.GuiCheckboxHandle] = []
        """Of the panels that take clicks; at most one of them is on."""
        self.value_range_shown: tuple[float, float] | None = None
        """Ends of the colour map of the picture shown; None where it has none."""
        self._legend_shown = ""
        self._object_owners: set[str] = set()
        self._notices: dict[str, viser.NotificationHandle] = {}
        self._last_warning = (-math.inf, "")
        self._notes: tuple[str, ...] = ()
        self._status = client.gui.add_html(paragraph("waiting for the first picture"))
        self._legend = client.gui.add_html("")

    def _first_state(self) -> PageState:
        maker, history = self.services.maker, RecipeHistory(self.services.first_recipe)
        settings = LayerSettings()
        if self.services.has_materials:
            settings = first_settings(maker.edited(Edit(history.present)).materials.bands)
        elif settings.layer not in maker.layers:
            settings = LayerSettings(layer=next(iter(maker.layers), settings.layer))
        rows = number(self.client.camera.image_height, DEFAULT_HEIGHT, HEIGHT_BOUNDS[1], DEFAULT_HEIGHT)
        return PageState(settings, history, int(rows) // 16 * 16)

    def open(self, panels: Sequence[tuple[str, Callable[[Session], object]]]) -> None:
        """Build the panels, given by their titles and what builds them in the tab that is open, and begin to render."""
        view, tabs = self.view, self.client.gui.add_tab_group()
        for title, build in panels:
            with tabs.add_tab(title):
                build(self)
        self.services.loop.add(view)
        if self.is_closed:  # the client left while its panels were built
            self.services.loop.remove(view)
            return
        if self.services.has_materials:
            self._show_notes(self.services.maker.edited(view.edit).notes)
        kept = view.pose
        self.client.camera.on_update(self._moved)
        if kept is None:
            camera = self.client.camera
            with suppress(ConfigError):
                pose = pose_from(camera)
                if pose.aspect < 1:  # on a phone's screen, as much across as otherwise from top to bottom
                    camera.fov = 2 * math.atan(math.tan(pose.fov / 2) / pose.aspect)
            self._moved(self.client.camera)
        else:
            self.services.loop.change(view, pose=kept)
            self.look_from(camera_of(kept, 64))

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
        sizes = (view.largest_height, view.subpixels)
        return PageState(view.settings, self.history, *sizes, view.pose, view.edit.light)

    def tick(self) -> None:
        """Update what panels show of a run in progress."""
        for tell in self.on_tick:
            self.guarded(tell)()

    def guarded(self, work: Callable[[], None]) -> Callable[..., None]:
        """A callback for the browser's events: one at a time for each client, with errors shown to it."""

        def callback(_event: Any = None) -> None:
            with self._lock, reporting_failures("that failed", self.warn):
                if not self.is_closed:
                    work()

        return callback

    def say(
        self, title: str, text: str, colour: Literal["teal", "red"] = "teal", in_place_of: str = ""
    ) -> None:
        """Show a notice, in place of the last one that had the same `in_place_of`, if that is given."""
        if self.is_closed:
            return
        if in_place_of in self._notices:
            self._notices.pop(in_place_of).remove()
        notice = self.client.add_notification(
            title, text[:_LONGEST_NOTICE], auto_close_seconds=_NOTICE_S, color=colour
        )
        if in_place_of:
            self._notices[in_place_of] = notice

    def warn(self, text: str, title: str = "not done") -> None:
        """Show a warning in place of the one before: a control that is dragged causes many. The same one is shown once
        in 8 s."""
        before, self._last_warning = self._last_warning, (time.monotonic(), text)
        if before[1] != text or self._last_warning[0] - before[0] >= _NOTICE_S:
            self.say(title, text, "red", "warning")

    def _show_notes(self, notes: tuple[str, ...]) -> None:
        """Show what is new among the notes of the edit in force, in place of those shown before."""
        new = [note for note in notes if note not in self._notes]
        self._notes = notes
        if new:
            self.say("edited", "; ".join(new), in_place_of="notes")

    def on_change(self, control: _ControlT, work: Callable[[], None]) -> _ControlT:
        """Let something be done when a user changes a control; the control."""
        update: Any = control
        update.on_update(self.guarded(lambda: None if self.is_filling else work()))
        return control

    @contextmanager
    def filling(self) -> Iterator[None]:
        """Context in which controls are set to what is in force."""
        self.is_filling = True
        try:
            yield
        finally:
            self.is_filling = False

    def add_button(
        self, label: str, work: Callable[[], None], colour: Literal["gray", "red"] | None = None
    ) -> viser.GuiButtonHandle:
        """Add a button to the folder that is open, and do something when it is clicked."""
        button = self.client.gui.add_button(label, color=colour)
        button.on_click(self.guarded(work))
        return button

    def add_buttons(self, label: str, names: Sequence[str], work: Callable[[str], None]) -> None:
        """Add buttons side by side, and do something with the name of the one that is clicked."""
        buttons = self.client.gui.add_button_group(label, names)
        buttons.on_click(self.guarded(lambda: work(str(buttons.value))))

    def materials(self) -> Materials:
        """The materials as this client sees them."""
        return self.services.maker.edited(self.view.edit).materials

    def colours_of(self, materials: Materials) -> list[tuple[float, ...]]:
        """sRGB colours that stand for materials."""
        return [tuple(row) for row in endmember_colours(materials).tolist()]

    def change_edit(self, edit: Edit) -> None:
        """Show the scene with other materials or light; an UnmixError if the edit does not fit: nothing changes."""
        notes = self.services.maker.edited(edit).notes
        self.show_edit(edit)
        self._show_notes(notes)

    def show_edit(self, edit: Edit) -> None:
        """The same of an edit that is known to fit; panels are told of it."""
        self.services.loop.change(self.view, edit=edit)
        for tell in self.on_edit:
            tell()

    def show_objects(self, owner: str, has_some: bool) -> None:
        """Note whether a panel shows objects of the browser's own, which need depth to be hidden behind the picture."""
        (self._object_owners.add if has_some else self._object_owners.discard)(owner)
        if (wanted := bool(self._object_owners)) != self.view.wants_depth:
            self.services.loop.change(self.view, wants_depth=wanted)

    def pose(self) -> ViewPose:
        """Where the client looks from now; a ConfigError if its camera is invalid."""
        return pose_from(self.client.camera)

    def look_from(self, camera: Cameras) -> None:
        """Move the client's camera to one of ours."""
        pose = pose_of(camera)
        with self.client.atomic():
            self.client.camera.wxyz = pose.wxyz
            self.client.camera.position = pose.position
            self.client.camera.look_at = point_ahead(camera, self.services.source.record.scene_box)
            self.client.camera.fov = pose.fov

    def show_busy(self, what: str) -> None:
        """Show what is being drawn, in place of what the last picture's colours mean, until it is there."""
        self._status.content = paragraph(f"drawing {what} ...")
        self._legend_shown = self._legend.content = ""

    def _moved(self, camera: viser.CameraHandle) -> None:
        """The client's camera moved; what it sends may be anything."""
        if self.is_closed:
            return
        with reporting_failures("the camera could not be read", self._report):
            self.services.loop.change(self.view, pose=pose_from(camera))

    def _show(self, shown: Picture) -> None:
        if self.is_closed:
            return
        height, width = shown.picture.shape[:2]
        self.client.scene.set_background_image(
            shown.picture,
            format="png" if shown.is_labels or height * width <= _SMALL_PIXELS else "jpeg",
            jpeg_quality=_MOVING_QUALITY if shown.is_moving else _RESTING_QUALITY,
            depth=shown.depth,
        )
        legend = shown.legend
        self.value_range_shown = (legend.low, legend.high) if isinstance(legend, ColourScale) else None
        if (content := legend_html(legend)) != self._legend_shown:
            self._legend_shown = self._legend.content = content
        if not self.view.has_reported:
            more = ", getting finer" if shown.is_moving else ""
            self._status.content = paragraph(f"{width} x {height} pixels{more}")

    def _report(self, text: str) -> None:
        """Show in the panel what is wrong with the picture, until it is right again."""
        if text and not self.is_closed:
            self._status.content = paragraph(text, is_warning=True)
