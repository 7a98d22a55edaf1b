"""Where the client looks from, how finely pictures are rendered, and which objects are shown with them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.viewer.inputs import number
from unmix_plugin.viewer.rendering.view import DEFAULT_HEIGHT, HEIGHT_BOUNDS, SUBPIXEL_BOUNDS
from unmix_plugin.viewer.scene_objects import add_box, add_cameras, add_points
from unmix_plugin.viewer.services import thumbnail
from unmix_plugin.viewer.session import Session

if TYPE_CHECKING:
    import viser

_HEIGHT_STEP = 16


class ScenePanel:
    """Cameras, quality and objects."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._objects: dict[str, list[Any]] = {}
        gui, services = session.client.gui, session.services
        with gui.add_folder("camera"):
            names = tuple(view.name for view in services.views)
            self._view = gui.add_dropdown("view of the scene", names)
            gui.add_button("look from there").on_click(session.guarded(self._look_from_view))
        with gui.add_folder("quality"):
            self._height = gui.add_slider(
                "finest picture (rows)", *HEIGHT_BOUNDS, _HEIGHT_STEP, session.view.largest_height
            )
            self._subpixels = gui.add_slider(
                "rays along a pixel's edge",
                *SUBPIXEL_BOUNDS,
                1,
                session.view.subpixels,
                hint="More smooth edges, for as much more time.",
            )
        for control in (self._height, self._subpixels):
            control.on_update(session.guarded(self._change_quality))
        with gui.add_folder("objects"):
            self._add_switch("cameras", self._add_cameras)
            self._add_switch("scene box", self._add_box)
            if services.has_materials:
                self._add_switch("point cloud", self._add_points)

    def _add_switch(self, label: str, make: Any) -> None:
        switch = self._session.client.gui.add_checkbox(label, False)

        def change() -> None:
            for handle in self._objects.pop(label, []):
                handle.remove()
            if switch.value is True:
                self._objects[label] = make()
            self._session.show_objects("scene", bool(self._objects))

        switch.on_update(self._session.guarded(change))

    def _look_from_view(self) -> None:
        view = self._session.services.view_named(str(self._view.value))
        if view is None:
            raise ConfigError(f"there is no view {str(self._view.value)[:40]!r}")
        self._session.look_from(view.camera)

    def _change_quality(self) -> None:
        height = int(number(self._height.value, *HEIGHT_BOUNDS, fallback=DEFAULT_HEIGHT))
        subpixels = int(number(self._subpixels.value, *SUBPIXEL_BOUNDS, fallback=1))
        self._session.services.loop.change_quality(self._session.view, height, subpixels)

    def _add_cameras(self) -> list[viser.CameraFrustumHandle]:
        services = self._session.services
        scene = services.scene
        thumbnails = (
            {} if scene is None else {view.name: thumbnail(scene, view.name) for view in services.views}
        )
        handles = add_cameras(self._session.client, list(services.views), services.num_train, thumbnails)
        for handle, view in zip(handles, services.views, strict=True):
            handle.on_click(self._session.guarded(lambda camera=view.camera: self._session.look_from(camera)))
        return handles

    def _add_box(self) -> list[Any]:
        return [add_box(self._session.client, self._session.services.source.record.scene_box)]

    def _add_points(self) -> list[Any]:
        """Surface points in the colours that the materials have now."""
        aids, materials = self._session.services.aids.for_layers(), self._session.materials()
        assert aids is not None
        spectra = aids.reference.spectra(materials)
        linear = (spectra @ rgb_matrix(materials.bands).to(spectra)).clamp(0, 1)
        colours = (linear_to_srgb(linear) * 255).byte().cpu().numpy().astype(np.uint8)
        return [add_points(self._session.client, aids.reference.points, colours)]
