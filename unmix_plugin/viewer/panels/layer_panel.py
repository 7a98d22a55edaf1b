"""What is shown, and how: layer, wavelengths, colour map, tones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.viewer.debounce import Debounced
from unmix_plugin.viewer.inputs import index_in, text
from unmix_plugin.viewer.layers.layer import layer_named
from unmix_plugin.viewer.layers.layer_settings import BACKGROUNDS, COLOUR_MAPS, EXPOSURE_BOUNDS, GAMMA_BOUNDS
from unmix_plugin.viewer.layers.layers import covered
from unmix_plugin.viewer.layers.view_transforms import VIEW_TRANSFORMS
from unmix_plugin.viewer.session import Session

if TYPE_CHECKING:
    import viser

    from unmix_plugin.spectral.materials import Materials

_TRANSFORMS = {title: name for name, title in VIEW_TRANSFORMS.items()}
_NO_INDEX = "none for these bands"


class LayerPanel:
    """Chooses the layer; shows the controls that it has."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._settings = settings = session.view.settings
        self._gui = session.client.gui
        self._of_control: dict[str, list[Any]] = {}
        self._layers = session.services.layers
        titles = {one.title: name for name, one in self._layers.items()}
        layer = self._gui.add_dropdown(
            "layer", tuple(titles), initial_value=layer_named(settings.layer, self._layers).title
        )
        self._connect(layer, "layer", lambda: titles.get(layer.value, layer.value))
        if session.services.has_materials:
            self._add_spectral(session.materials())
        self._add_scale()
        self._add_tone()
        background = self._gui.add_dropdown(
            "background", tuple(BACKGROUNDS), initial_value=settings.background
        )
        self._connect(background, "background", lambda: background.value)
        self._show_controls()

    def _add_spectral(self, materials: Materials) -> None:
        """What is chosen by wavelength or by endmember."""
        bands, settings = materials.bands, self._settings
        edges = bands.edges_nm
        self._low_nm, self._high_nm = float(edges[0]), float(edges[-1])
        wavelength = self._wavelength_slider("wavelength (nm)", covered(bands, settings.wavelength_nm))
        self._connect(wavelength, "wavelength_nm", lambda: wavelength.value, "wavelength")
        self._add_false_colour()
        endmember = materials.names[min(settings.endmember, len(materials.names) - 1)]
        self._endmember = self._gui.add_dropdown("endmember", materials.names, initial_value=endmember)
        self._connect(self._endmember, "endmember", self._chosen_endmember, "endmember")
        self._add_index(bands)
        self._session.on_edit.append(self._show_names)

    def _show_names(self) -> None:
        """Endmembers may have other names."""
        names = self._session.materials().names
        if tuple(self._endmember.options) != names:
            self._endmember.options = names
            self._endmember.value = names[min(self._settings.endmember, len(names) - 1)]

    def _add_false_colour(self) -> None:
        sliders = [
            self._wavelength_slider(f"{name} (nm)", start)
            for name, start in zip(("red", "green", "blue"), self._settings.false_colour_nm, strict=True)
        ]
        for slider in sliders:
            self._connect(
                slider, "false_colour_nm", lambda: tuple(one.value for one in sliders), "false-colour"
            )

    def _wavelength_slider(self, label: str, start: float) -> viser.GuiSliderHandle[float]:
        step = max((self._high_nm - self._low_nm) / 500, 0.01)
        return self._gui.add_slider(label, self._low_nm, self._high_nm, round(step, 2), start)

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
            hint="Such as (r650-r550)/(r650+r550), where r650 is the reflectance at 650 nm; empty: the index above.",
        )

        def chosen() -> str:
            return text(formula.value).strip() or (text(known.value) if names else "")

        self._connect(known, "index", chosen, "index")
        self._of_control["index"].append(formula)
        typed = Debounced(lambda: self._change("index", chosen))
        formula.on_update(self._session.guarded(typed.note))
        self._session.on_tick.append(typed.tick)

    def _add_scale(self) -> None:
        colour_map = self._gui.add_dropdown("colours", COLOUR_MAPS, initial_value=self._settings.colour_map)
        self._connect(colour_map, "colour_map", lambda: colour_map.value, "scale")
        own_range = self._settings.value_range
        is_own = self._gui.add_checkbox(
            "own range", own_range is not None, hint="Choose the values at the ends of the colour map."
        )
        ends = [
            self._gui.add_number(label, value, step=1e-4)
            for label, value in zip(("low", "high"), own_range or (0.0, 1.0), strict=True)
        ]

        def value_range() -> tuple[Any, ...] | None:
            return tuple(end.value for end in ends) if is_own.value else None

        def start_from_shown() -> None:
            """The range begins as the one that is shown."""
            if is_own.value and self._session.value_range_shown is not None:
                for end, value in zip(ends, self._session.value_range_shown, strict=True):
                    end.value = value

        is_own.on_update(self._session.guarded(start_from_shown))
        self._connect(is_own, "value_range", value_range, "scale")
        for end in ends:
            self._connect(end, "value_range", value_range, "own-range")

    def _add_tone(self) -> None:
        settings = self._settings
        exposure = self._gui.add_slider("exposure (stops)", *EXPOSURE_BOUNDS, 0.1, settings.exposure_ev)
        self._connect(exposure, "exposure_ev", lambda: exposure.value, "tone")
        gamma = self._gui.add_slider("gamma", *GAMMA_BOUNDS, 0.05, settings.gamma)
        self._connect(gamma, "gamma", lambda: gamma.value, "tone")
        transform = self._gui.add_dropdown(
            "tones", tuple(_TRANSFORMS), initial_value=VIEW_TRANSFORMS[settings.view_transform]
        )
        self._connect(transform, "view_transform", lambda: _TRANSFORMS.get(transform.value), "tone")

    def _connect(self, control: Any, setting: str, read: Callable[[], Any], kind: str | None = None) -> None:
        """Let a control change a setting, checked; show it only for layers that have its kind."""
        if kind is not None:
            self._of_control.setdefault(kind, []).append(control)
        control.on_update(self._session.guarded(lambda: self._change(setting, read)))

    def _change(self, setting: str, read: Callable[[], Any]) -> None:
        self._settings = self._settings.changed(setting, read())
        if setting in ("layer", "value_range"):
            self._show_controls()
        self._session.restyle(self._settings)

    def _chosen_endmember(self) -> int:
        return index_in(self._endmember)

    def _show_controls(self) -> None:
        wanted = layer_named(self._settings.layer, self._layers).controls
        if "scale" in wanted and self._settings.value_range is not None:
            wanted = wanted | {"own-range"}
        for kind, controls in self._of_control.items():
            for control in controls:
                control.visible = kind in wanted
