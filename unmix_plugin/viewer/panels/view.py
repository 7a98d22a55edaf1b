"""What is shown, in which light, from where and how finely; and objects of the browser's own beside the picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import UInt8

from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.viewer.page import Debounced, choice, index_in, number, text
from unmix_plugin.viewer.recipes import visibility
from unmix_plugin.viewer.rendering.painting import layer_named
from unmix_plugin.viewer.rendering.pictures import DEFAULT_HEIGHT, HEIGHT_BOUNDS, SUBPIXEL_BOUNDS
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.rendering.settings import (
    BACKGROUNDS,
    COLOUR_MAPS,
    EXPOSURE_BOUNDS,
    GAMMA_BOUNDS,
    VIEW_TRANSFORMS,
    covered,
)
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import pose_of

if TYPE_CHECKING:
    import viser

_NO_INDEX = "none for these bands"


class LayerPanel:
    """Chooses the layer, and shows the controls that it has: wavelengths, colour map, tones."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._settings = settings = session.view.settings
        self._gui = session.client.gui
        self._of_control: dict[str, list[Any]] = {}
        self._is_filling = False
        self._layers = session.services.maker.layers
        titles = {one.title: name for name, one in self._layers.items()}
        shown = layer_named(settings.layer, self._layers).title
        layer = self._gui.add_dropdown("layer", tuple(titles), initial_value=shown)
        self._connect(layer, "layer", read=lambda: titles.get(layer.value, layer.value))
        if session.services.has_materials:
            self._add_spectral(session.materials())
        self._add_scale()
        exposure = self._gui.add_slider("exposure (stops)", *EXPOSURE_BOUNDS, 0.1, settings.exposure_ev)
        self._connect(exposure, "exposure_ev", "tone")
        self._connect(self._gui.add_slider("gamma", *GAMMA_BOUNDS, 0.05, settings.gamma), "gamma", "tone")
        transforms = {title: name for name, title in VIEW_TRANSFORMS.items()}
        shown = VIEW_TRANSFORMS[settings.view_transform]
        transform = self._gui.add_dropdown("highlights", tuple(transforms), initial_value=shown)
        self._connect(transform, "view_transform", "tone", lambda: transforms.get(transform.value))
        backgrounds = tuple(BACKGROUNDS)
        background = self._gui.add_dropdown("background", backgrounds, initial_value=settings.background)
        self._connect(background, "background")
        self._show_controls()

    def _add_spectral(self, materials: Materials) -> None:
        """What is chosen by wavelength, by endmember or by an index."""
        bands, settings = materials.bands, self._settings
        low_nm, high_nm = float(bands.edges_nm[0]), float(bands.edges_nm[-1])
        step = round(max((high_nm - low_nm) / 500, 0.01), 2)
        start = covered(bands, settings.wavelength_nm)
        wavelength = self._gui.add_slider("wavelength (nm)", low_nm, high_nm, step, start)
        self._connect(wavelength, "wavelength_nm", "wavelength")
        sliders = [
            self._gui.add_slider(f"{name} (nm)", low_nm, high_nm, step, start)
            for name, start in zip(("red", "green", "blue"), settings.false_colour_nm, strict=True)
        ]
        for slider in sliders:
            self._connect(
                slider, "false_colour_nm", "false-colour", lambda: tuple(one.value for one in sliders)
            )
        name = materials.names[min(settings.endmember, len(materials.names) - 1)]
        self._endmember = self._gui.add_dropdown("endmember", materials.names, initial_value=name)
        self._connect(self._endmember, "endmember", "endmember", lambda: index_in(self._endmember))
        self._add_index(bands)
        self._session.on_edit.append(self._show_names)

    def _show_names(self) -> None:
        """Endmembers may have other names."""
        names = self._session.materials().names
        if tuple(self._endmember.options) != names:
            self._endmember.options = names
            self._endmember.value = names[min(self._settings.endmember, len(names) - 1)]

    def _add_index(self, bands: Bands) -> None:
        """The named indices that the bands allow, and a formula that overrides them."""
        names = tuple(available_indices(bands))
        options, index = names or (_NO_INDEX,), self._settings.index
        known = self._gui.add_dropdown(
            "index", options, initial_value=index if index in names else options[0]
        )
        formula = self._gui.add_text(
            "formula",
            "" if index in names else index,
            hint="Such as (r650-r550)/(r650+r550), where r650 is the reflectance at 650 nm; or "
            "absorption:centre:650-700 (or depth, area); empty: the index above.",
        )

        def chosen() -> str:
            return text(formula.value).strip() or (text(known.value) if names else "")

        self._connect(known, "index", "index", chosen)
        self._of_control["index"].append(formula)
        typed = Debounced(lambda: self._change("index", chosen))
        formula.on_update(self._session.guarded(typed.note))
        self._session.on_tick.append(typed.tick)

    def _add_scale(self) -> None:
        colour_map = self._gui.add_dropdown(
            "colour map", COLOUR_MAPS, initial_value=self._settings.colour_map
        )
        self._connect(colour_map, "colour_map", "scale")
        own_range = self._settings.value_range
        is_own = self._gui.add_checkbox(
            "own range", own_range is not None, hint="Choose the values at the ends of the colour map."
        )
        ends = [
            self._gui.add_number(label, value, step=1e-4)
            for label, value in zip(("low", "high"), own_range or (0.0, 1.0), strict=True)
        ]

        def value_range() -> tuple[Any, ...] | None:
            if not is_own.value or self._is_filling:
                return None
            low, high = (number(end.value, -math.inf, math.inf, fallback=math.nan) for end in ends)
            if low >= high:
                raise ConfigError(
                    f"low is {low:g} and high {high:g}; the range stays until low is below high"
                )
            return low, high

        def start_from_shown() -> None:
            if is_own.value and self._session.value_range_shown is not None:
                shown = self._session.value_range_shown
                self._is_filling = True
                for end, value in zip(ends, shown, strict=True):
                    end.value = value
                self._is_filling = False

        is_own.on_update(self._session.guarded(start_from_shown))
        self._connect(is_own, "value_range", "scale", value_range)
        for end in ends:
            self._connect(end, "value_range", "own-range", value_range)

    def _connect(
        self, control: Any, setting: str, kind: str | None = None, read: Callable[[], Any] | None = None
    ) -> None:
        """Let a control, or what `read` says, change a setting, checked; show it only for layers that have its kind."""
        if kind is not None:
            self._of_control.setdefault(kind, []).append(control)
        read = read or (lambda: control.value)
        control.on_update(self._session.guarded(lambda: self._change(setting, read)))

    def _change(self, setting: str, read: Callable[[], Any]) -> None:
        self._settings = self._settings.changed(setting, read())
        if setting in ("layer", "value_range"):
            self._show_controls()
        if setting == "layer":
            self._session.say_busy(layer_named(self._settings.layer, self._layers).title)
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
        self._lights = session.services.lights
        gui, light = session.client.gui, session.view.edit.light
        name = choice(light.name, self._lights, self._lights[0])
        self._name = gui.add_dropdown("environment", self._lights, initial_value=name)
        self._rotation = gui.add_slider("turned by (deg)", *_ROTATION_BOUNDS, 1.0, light.rotation_deg)
        self._exposure = gui.add_slider(
            "brightness (stops)",
            *_BRIGHTNESS_BOUNDS,
            0.1,
            light.exposure_stops,
            hint="Of the light itself; the exposure of the picture is under view.",
        )
        for control in (self._name, self._rotation, self._exposure):
            control.on_update(session.guarded(self._change))

    def _change(self) -> None:
        name = choice(self._name.value, self._lights, self._lights[0])
        light = LightChoice(
            None if name == self._lights[0] else name,
            number(self._rotation.value, *_ROTATION_BOUNDS, fallback=0.0),
            number(self._exposure.value, *_BRIGHTNESS_BOUNDS, fallback=0.0),
        )
        view = self._session.view
        self._session.services.loop.change(view, edit=Edit(view.edit.recipe, light))


_HEIGHT_STEP = 16
_LARGEST_FRUSTUM = 0.12
_FRUSTUM_SHARE = 0.3
"""Size of a frustum in the distance to its nearest neighbour, so that frusta do not cover each other."""
_TRAIN_COLOUR, _EVAL_COLOUR = (40, 120, 200), (220, 120, 30)
_THUMBNAIL_HEIGHT = 96
_POINT_SIZE = 0.012
_MOST_POINTS = 20_000


class ScenePanel:
    """Where the client looks from, how finely pictures are rendered, and which objects are shown with them."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._objects: dict[str, list[Any]] = {}
        gui, services = session.client.gui, session.services
        self._views = {view.name: view.camera for view in services.views}
        with gui.add_folder("camera"):
            self._view = gui.add_dropdown("view of the scene", tuple(self._views))
            session.add_button("look from there", self._look_from_view)
        with gui.add_folder("quality"):
            self._height = gui.add_slider(
                "picture height (px)",
                *HEIGHT_BOUNDS,
                _HEIGHT_STEP,
                session.view.largest_height,
                hint="Of the finest picture, which comes when the camera rests; more takes longer.",
            )
            self._subpixels = gui.add_slider(
                "smooth edges",
                *SUBPIXEL_BOUNDS,
                1,
                session.view.subpixels,
                hint="Rays along the edge of a pixel, 1 to 4: 2 takes four times as long as 1.",
            )
        for control in (self._height, self._subpixels):
            control.on_update(session.guarded(self._change_quality))
        with gui.add_folder("objects"):
            self._add_switch("cameras", self._add_cameras)
            self._add_switch("scene box", self._add_box)
            if services.has_materials:
                self._add_switch("point cloud", self._add_points)
                session.on_edit.append(self._renew_points)

    def _renew_points(self) -> None:
        """Materials may have other colours, or be hidden."""
        if "point cloud" in self._objects:
            for handle in self._objects["point cloud"]:
                handle.remove()
            self._objects["point cloud"] = self._add_points()

    def _add_switch(self, label: str, make: Callable[[], list[Any]]) -> None:
        switch = self._session.client.gui.add_checkbox(label, False)

        def change() -> None:
            for handle in self._objects.pop(label, []):
                handle.remove()
            if switch.value is True:
                self._objects[label] = make()
            self._session.show_objects("scene", bool(self._objects))

        switch.on_update(self._session.guarded(change))

    def _look_from_view(self) -> None:
        name = str(self._view.value)
        if name not in self._views:
            raise ConfigError(f"there is no view {name[:40]!r}")
        self._session.look_from(self._views[name])

    def _change_quality(self) -> None:
        height = int(number(self._height.value, *HEIGHT_BOUNDS, fallback=DEFAULT_HEIGHT))
        subpixels = int(number(self._subpixels.value, *SUBPIXEL_BOUNDS, fallback=1))
        self._session.services.loop.change(self._session.view, largest_height=height, subpixels=subpixels)

    def _add_cameras(self) -> list[viser.CameraFrustumHandle]:
        """A frustum for each view, with its image where there is one; a click looks from there."""
        services, cameras = self._session.services, list(self._views.values())
        size, places = _LARGEST_FRUSTUM, torch.cat([one.camera_to_world[:, :, 3] for one in cameras]).cpu()
        if len(places) > 1:
            nearest = torch.cdist(places, places).fill_diagonal_(torch.inf).min(dim=1).values
            size = min(size, max(_FRUSTUM_SHARE * float(nearest.median()), 1e-3))
        handles = []
        for index, (name, camera) in enumerate(self._views.items()):
            pose, is_train = pose_of(camera), index < len(services.source.record.train_cameras)
            handle = self._session.client.scene.add_camera_frustum(
                f"/cameras/{index:04d}",
                fov=pose.fov,
                aspect=pose.aspect,
                scale=size,
                color=_TRAIN_COLOUR if is_train else _EVAL_COLOUR,
                image=None if services.scene is None else _thumbnail(services.scene, name),
                wxyz=pose.wxyz,
                position=pose.position,
            )
            handle.on_click(self._session.guarded(lambda camera=camera: self._session.look_from(camera)))
            handles.append(handle)
        return handles

    def _add_box(self) -> list[viser.LineSegmentsHandle]:
        """The twelve edges of the scene box."""
        low, high = self._session.services.source.record.scene_box.aabb.cpu().numpy()
        corners = np.array([[(low, high)[(i >> axis) & 1][axis] for axis in range(3)] for i in range(8)])
        edges = [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i & 1 << axis]
        points = np.array([[corners[start], corners[end]] for start, end in edges], dtype=np.float32)
        scene = self._session.client.scene
        return [scene.add_line_segments("/box", points, colors=(120, 120, 120))]

    def _add_points(self) -> list[viser.PointCloudHandle]:
        """Surface points of the materials that are visible, in the colours that these have now; every n-th where there
        are too many."""
        aids, materials = self._session.services.maker.aids.for_layers(), self._session.materials()
        assert aids is not None
        hidden, isolated = visibility(self._session.history.present)
        is_shown = [i not in hidden and (not isolated or i in isolated) for i in range(len(materials.names))]
        main = aids.reference.abundances.argmax(dim=-1).cpu().numpy()
        spectra, kept = aids.reference_spectra(materials), np.array(is_shown)[main]
        linear = (spectra @ rgb_matrix(materials.bands).to(spectra)).clamp(0, 1)
        colours = (linear_to_srgb(linear) * 255).byte().cpu().numpy()[kept]
        points = aids.reference_points.cpu().numpy()[kept]
        step = max(1, -(-len(points) // _MOST_POINTS))
        scene = self._session.client.scene
        if len(points) == 0:
            return []
        return [scene.add_point_cloud("/points", points[::step], colours[::step], point_size=_POINT_SIZE)]


def _thumbnail(scene: Scene, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
    """A view as measured, in few pixels; None for a name that the scene does not have."""
    index = next((index for index, frame in enumerate(scene.frames) if frame.name == name), None)
    if index is None:
        return None
    picture = scene.srgb(index)
    if picture is not None:
        step = max(1, picture.shape[0] // _THUMBNAIL_HEIGHT)
        return np.ascontiguousarray((picture[::step, ::step] * 255 + 0.5).astype(np.uint8))
    cube = scene.cube(index)
    step = max(1, cube.shape[0] // _THUMBNAIL_HEIGHT)
    spectra = torch.from_numpy(np.ascontiguousarray(cube[::step, ::step]))
    sensor = scene.sensor_of(index)
    false_colours = torch.from_numpy(sensor.false_colours).to(spectra)
    weights = rgb_matrix(Bands.of(scene.wavelengths_nm)) if sensor.sees_all_bands else false_colours
    linear = (spectra @ weights).clamp(0, 1)
    return (linear_to_srgb(linear) * 255 + 0.5).to(torch.uint8).numpy()
