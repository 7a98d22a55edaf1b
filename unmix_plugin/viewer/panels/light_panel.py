"""Which light falls on an object: the environment, how it is turned, how bright it is."""

from __future__ import annotations

from unmix_plugin.trained.relighting import LightChoice
from unmix_plugin.viewer.inputs import choice, number
from unmix_plugin.viewer.session import Session

_ROTATION_BOUNDS, _EXPOSURE_BOUNDS = (-180.0, 180.0), (-6.0, 6.0)


class LightPanel:
    """Chooses and turns the light."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._lights = session.services.lights
        gui, light = session.client.gui, session.view.edit.light
        name = choice(light.name, self._lights, self._lights[0])
        self._name = gui.add_dropdown("environment", self._lights, initial_value=name)
        self._rotation = gui.add_slider("turned by (deg)", *_ROTATION_BOUNDS, 1.0, light.rotation_deg)
        self._exposure = gui.add_slider(
            "brightness (stops)",
            *_EXPOSURE_BOUNDS,
            0.1,
            light.exposure_stops,
            hint="Of the light itself; the exposure of the picture is under view.",
        )
        for control in (self._name, self._rotation, self._exposure):
            control.on_update(session.guarded(self._change))

    def _change(self) -> None:
        name = choice(self._name.value, self._lights, self._lights[0])
        self._session.change_light(
            LightChoice(
                None if name == self._lights[0] else name,
                number(self._rotation.value, *_ROTATION_BOUNDS, fallback=0.0),
                number(self._exposure.value, *_EXPOSURE_BOUNDS, fallback=0.0),
            )
        )
