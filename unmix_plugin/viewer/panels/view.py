"""What is shown, in which light, from where and how finely; and objects of the browser's own beside the picture."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.look import BACKGROUNDS
from unmix_plugin.formats.files import eight_bits
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.viewer.page import Debounced, choice, index_in, number, number_of, reporting_failures, text
from unmix_plugin.viewer.recipes import is_shown
from unmix_plugin.viewer.rendering.painting import layer_named
from unmix_plugin.viewer.rendering.pictures import DEFAULT_HEIGHT, HEIGHT_BOUNDS, SUBPIXEL_BOUNDS
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.rendering.settings import (
    COLOUR_MAPS,
    EXPOSURE_BOUNDS,
    GAMMA_BOUNDS,
    HIGHLIGHTS,
    covered,
)
from unmix_plugin.viewer.rendering.thumbnails import Thumbnails
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import pose_of

if TYPE_CHECKING:
    import viser

_NO_INDEX = "none for these bands"
_FORMULA_HINT = (
    "Such as (r650-r550)/(r650+r550), where r650 is the reflectance at 650 nm; or absorption:centre:650-700 (or depth, "
    "area); empty: the index above."
)


class LayerPanel:
    """Chooses the layer, and shows the controls that it has: wavelengths, colour map, tones."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._settings = settings = session.view.settings
        self._gui = session.client.gui
        self._of_control: dict[str, list[Any]] = {}
        self._layers = session.services.maker.layers
        self._add_menu("layer", "layer", {name: one.title for name, one in self._layers.items()})
        if session.services.has_materials:
            self._add_spectral(session.materials())
        self._add_menu("colour map", "colour_map", {name: name for name in COLOUR_MAPS}, "scale")
        self._add_range()
        exposure = self._gui.add_slider("exposure (stops)", *EXPOSURE_BOUNDS, 0.1, settings.exposure)
        self._connect(exposure, "exposure", "tone")
        self._connect(self._gui.add_slider("gamma", *GAMMA_BOUNDS, 0.05, settings.gamma), "gamma", "tone")
        self._add_menu("highlights", "highlights", HIGHLIGHTS, "tone")
        self._add_menu("background", "background", {name: name for name in BACKGROUNDS})
        self._show_controls()

    def _add_menu(self, label: str, setting: str, titles: Mapping[Any, str], kind: str | None = None) -> None:
        """A menu of the values of a setting, by what users read of them."""
        names = {title: name for name, title in titles.items()}
        shown = titles[getattr(self._settings, setting)]
        menu = self._gui.add_dropdown(label, tuple(names), initial_value=shown)
        self._connect(menu, setting, kind, lambda: names.get(menu.value, menu.value))

    def _add_spectral(self, materials: Materials) -> None:
        """What is chosen by wavelength, by endmember or by an index."""
        bands, settings = materials.bands, self._settings
        low_nm, high_nm = float(bands.edges_nm[0]), float(bands.edges_nm[-1])
        step = round(max((high_nm - low_nm) / 500, 0.01), 2)
        wavelength, *sliders = (
            self._gui.add_slider(f"{name} (nm)", low_nm, high_nm, step, start)
            for name, start in zip(
                ("wavelength", "red", "green", "blue"),
                (covered(bands, settings.wavelength_nm), *settings.false_colour_nm),
                strict=True,
            )
        )
        self._connect(wavelength, "wavelength_nm", "wavelength")

        def false_colour() -> tuple[float, ...]:
            return tuple(slider.value for slider in sliders)

        for slider in sliders:
            self._connect(slider, "false_colour_nm", "false-colour", false_colour)
        name = materials.names[min(settings.endmember, len(materials.names) - 1)]
        self._endmember = self._gui.add_dropdown("endmember", materials.names, initial_value=name)
        self._connect(self._endmember, "endmember", "endmember", lambda: index_in(self._endmember))
        self._session.on_edit.append(self._show_names)
        self._add_index(bands)

    def _show_names(self) -> None:
        """Endmembers may have other names."""
        names = self._session.materials().names
        if tuple(self._endmember.options) != names:
            self._endmember.options = names
            self._endmember.value = names[min(self._settings.endmember, len(names) - 1)]

    def _add_index(self, bands: Bands) -> None:
        """The named indices that the bands allow, and a formula that overrides them."""
        names, index = tuple(available_indices(bands)), self._settings.index
        options = names or (_NO_INDEX,)
        first, typed = (index, "") if index in names else (options[0], index)
        known = self._gui.add_dropdown("index", options, initial_value=first)
        formula = self._gui.add_text("formula", typed, hint=_FORMULA_HINT)

        def chosen() -> str:
            return text(formula.value).strip() or (text(known.value) if names else "")

        self._connect(known, "index", "index", chosen)
        self._of_control["index"].append(formula)
        waiting = Debounced(lambda: self._change("index", chosen()))
        self._session.on_change(formula, waiting.note)
        self._session.on_tick.append(waiting.tick)

    def _add_range(self) -> None:
        """The ends of the colour map: the layer's, or one's own, which begin as they were."""
        own_range, hint = self._settings.value_range, "Choose the values at the ends of the colour map."
        is_own = self._own_range = self._gui.add_checkbox("own range", own_range is not None, hint=hint)
        ends = [
            self._gui.add_number(label, value, step=1e-4)
            for label, value in zip(("low", "high"), own_range or (0.0, 1.0), strict=True)
        ]

        def read() -> tuple[float, ...] | None:
            if not is_own.value:
                return None
            low, high = (number(end.value, -math.inf, math.inf, fallback=math.nan) for end in ends)
            if low >= high:
                raise ConfigError(
                    f"low is {low:g} and high {high:g}; the range stays until low is below high"
                )
            return low, high

        def start() -> None:
            shown = self._session.value_range_shown
            if is_own.value and shown is not None:
                with self._session.filling():
                    for end, value in zip(ends, shown, strict=True):
                        end.value = value

        self._session.on_change(is_own, start)
        self._connect(is_own, "value_range", "scale", read)
        for end in ends:
            self._connect(end, "value_range", "own-range", read)

    def _connect(
        self, control: Any, setting: str, kind: str | None = None, read: Callable[[], Any] | None = None
    ) -> None:
        """Let a control, or what `read` says, change a setting, checked; show it only for layers that have its kind."""
        if kind is not None:
            self._of_control.setdefault(kind, []).append(control)
        self._session.on_change(
            control, lambda: self._change(setting, control.value if read is None else read())
        )

    def _change(self, setting: str, value: Any) -> None:
        self._settings = self._settings.changed(setting, value)
        if setting in ("layer", "value_range"):
            self._show_controls()
        if setting == "layer":
            self._own_range.value = False  # such ends mean nothing of other values
            self._session.show_busy(layer_named(self._settings.layer, self._layers).title)
        self._session.services.loop.change(self._session.view, settings=self._settings)

    def _show_controls(self) -> None:
        wanted = layer_named(self._settings.layer, self._layers).controls
        if "scale" in wanted and self._settings.value_range is not None:
            wanted = wanted | {"own-range"}
        for kind, controls in self._of_control.items():
            for control in controls:
                control.visible = kind in wanted


_ROTATION_BOUNDS, _BRIGHTNESS_BOUNDS = (-180.0, 180.0), (-6.0, 6.0)


class LightPanel:
    """Chooses the light that falls on an object: the environment, how it is turned, how bright it is."""

    def __init__(self, session: Session) -> None:
        self._session = session
        gui, light, lights = session.client.gui, session.view.edit.light, session.services.lights
        hint = "Of the light itself; the exposure of the picture is under view."
        name = choice(light.name, lights, lights[0])
        self._name = gui.add_dropdown("environment", lights, initial_value=name)
        self._rotation = gui.add_slider("turned by (deg)", *_ROTATION_BOUNDS, 1.0, light.rotation_deg)
        self._exposure = gui.add_slider(
            "brightness (stops)", *_BRIGHTNESS_BOUNDS, 0.1, light.exposure_stops, hint=hint
        )
        for control in (self._name, self._rotation, self._exposure):
            session.on_change(control, self._change)

    def _change(self) -> None:
        name = choice(self._name.value, self._session.services.lights[1:], None)
        light = LightChoice(name, number_of(self._rotation, 0.0), number_of(self._exposure, 0.0))
        self._session.show_edit(Edit(self._session.view.edit.recipe, light))


_HEIGHT_STEP = 16
_LARGEST_FRUSTUM = 0.12
_FRUSTUM_SHARE = 0.3
"""Size of a frustum in the distance to its nearest neighbour, so that frusta do not cover each other."""
_TRAIN_COLOUR, _EVAL_COLOUR = (40, 120, 200), (220, 120, 30)
_READ_S = 10.0
"""How long the image that is being read is waited for when a page closes."""
_POINT_SIZE = 0.012
_MOST_POINTS = 20_000


class ScenePanel:
    """Where the client looks from, how finely pictures are rendered, and which objects are shown with them."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._objects: dict[str, list[Any]] = {}
        self._reader: threading.Thread | None = None
        """Reads images of cameras."""
        # A thread in native code when the interpreter ends takes the process down with it.
        session.on_close.append(lambda: self._reader and self._reader.join(_READ_S))
        gui, services = session.client.gui, session.services
        self._views = {view.name: view.camera for view in services.views}
        with gui.add_folder("camera"):
            self._view = gui.add_dropdown("view of the scene", tuple(self._views))
            session.add_button("look from there", self._look_from_view)
        view, height = (
            session.view,
            "Of the finest picture, which comes when the camera rests; more takes longer.",
        )
        rays = "Rays along the edge of a pixel, 1 to 4: 2 takes four times as long as 1."
        with gui.add_folder("quality"):
            self._height = gui.add_slider(
                "picture height (px)", *HEIGHT_BOUNDS, _HEIGHT_STEP, view.largest_height, hint=height
            )
            self._subpixels = gui.add_slider("smooth edges", *SUBPIXEL_BOUNDS, 1, view.subpixels, hint=rays)
        for control in (self._height, self._subpixels):
            session.on_change(control, self._change_quality)
        with gui.add_folder("objects"):
            self._add_switch("cameras", self._add_cameras)
            self._add_switch("scene box", self._add_box)
            if services.has_materials:
                self._add_switch("point cloud", self._add_points)
                session.on_edit.append(self._renew_points)

    def _renew_points(self) -> None:
        """Materials may have other colours, or be hidden."""
        if "point cloud" in self._objects:
            self._show("point cloud", self._add_points)

    def _add_switch(self, label: str, make: Callable[[], list[Any]]) -> None:
        switch = self._session.client.gui.add_checkbox(label, False)
        self._session.on_change(switch, lambda: self._show(label, make if switch.value is True else None))

    def _show(self, label: str, make: Callable[[], list[Any]] | None) -> None:
        for handle in self._objects.pop(label, []):
            handle.remove()
        if make is not None:
            self._objects[label] = make()
        self._session.show_objects("scene", bool(self._objects))

    def _look_from_view(self) -> None:
        name = str(self._view.value)
        if name not in self._views:
            raise ConfigError(f"there is no view {name[:40]!r}")
        self._session.look_from(self._views[name])

    def _change_quality(self) -> None:
        height = int(number_of(self._height, DEFAULT_HEIGHT))
        subpixels = int(number_of(self._subpixels, 1))
        self._session.services.loop.change(self._session.view, largest_height=height, subpixels=subpixels)

    def _add_cameras(self) -> list[viser.CameraFrustumHandle]:
        """A frustum for each view, which gets its image as soon as that is read; a click looks from there."""
        services, cameras = self._session.services, list(self._views.values())
        size, places = _LARGEST_FRUSTUM, torch.cat([one.camera_to_world[:, :, 3] for one in cameras]).cpu()
        if len(places) > 1:
            nearest = torch.cdist(places, places).fill_diagonal_(torch.inf).min(dim=1).values
            size = min(size, max(_FRUSTUM_SHARE * float(nearest.median()), 1e-3))
        handles = []
        for index, camera in enumerate(cameras):
            pose, is_train = pose_of(camera), index < len(services.source.record.train_cameras)
            handle = self._session.client.scene.add_camera_frustum(
                f"/cameras/{index:04d}",
                fov=pose.fov,
                aspect=pose.aspect,
                scale=size,
                thickness=2.0,
                thickness_units="screen",
                color=_TRAIN_COLOUR if is_train else _EVAL_COLOUR,
                wxyz=pose.wxyz,
                position=pose.position,
            )
            handle.on_click(self._session.guarded(lambda camera=camera: self._session.look_from(camera)))
            handles.append(handle)
        if services.thumbnails is not None:
            self._reader = threading.Thread(
                target=self._read_images,
                args=(services.thumbnails, handles),
                name="unmix-viewer-images",
                daemon=True,
            )
            self._reader.start()
        return handles

    def _read_images(self, thumbnails: Thumbnails, frusta: list[viser.CameraFrustumHandle]) -> None:
        """Give frusta their images one by one, while pages go on, until the frusta are removed."""
        session = self._session
        with reporting_failures("images of the views could not be read", session.warn):
            for name, frustum in zip(self._views, frusta, strict=True):
                image = thumbnails.of(name)

                def show(frustum: viser.CameraFrustumHandle = frustum, image: Any = image) -> None:
                    if self._objects.get("cameras") is frusta:
                        frustum.image = image

                session.guarded(show)()
                if session.is_closed or self._objects.get("cameras") is not frusta:
                    return

    def _add_box(self) -> list[viser.LineSegmentsHandle]:
        low, high = self._session.services.source.record.scene_box.aabb.cpu().numpy()
        corners = np.array([[(low, high)[(i >> axis) & 1][axis] for axis in range(3)] for i in range(8)])
        edges = [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i & 1 << axis]
        points = np.array([[corners[start], corners[end]] for start, end in edges], dtype=np.float32)
        scene = self._session.client.scene
        return [
            scene.add_line_segments("/box", points, (120, 120, 120), thickness=2.0, thickness_units="screen")
        ]

    def _add_points(self) -> list[viser.PointCloudHandle]:
        """Surface points of the materials that are visible, in the colours that these have now; every n-th where there
        are too many."""
        shown = self._session.services.maker.edited(self._session.view.edit)
        aids, materials = self._session.services.maker.aids.for_layers(shown), shown.materials
        recipe = self._session.history.present
        are_shown = np.array([is_shown(recipe, index) for index in range(len(materials.names))])
        main = aids.reference.abundances.argmax(dim=-1).cpu().numpy()
        spectra, kept = aids.reference_spectra(materials), are_shown[main]
        linear = (spectra @ rgb_matrix(materials.bands).to(spectra)).clamp(0, 1)
        colours = eight_bits(linear_to_srgb(linear).cpu().numpy())[kept]
        points = aids.reference_points.cpu().numpy()[kept]
        step = max(1, -(-len(points) // _MOST_POINTS))
        scene = self._session.client.scene
        if len(points) == 0:
            return []
        return [scene.add_point_cloud("/points", points[::step], colours[::step], point_size=_POINT_SIZE)]
