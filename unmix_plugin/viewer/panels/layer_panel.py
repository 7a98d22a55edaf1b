"""What is shown, and how: layer, wavelengths, colour map, tones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.viewer.inputs import text
from unmix_plugin.viewer.layers.layer_settings import EXPOSURE_BOUNDS, GAMMA_BOUNDS, LayerSettings
from unmix_plugin.viewer.layers.layers import LAYERS, covered, layer_named
from unmix_plugin.viewer.layers.painting import BACKGROUNDS, COLOUR_MAPS
from unmix_plugin.viewer.layers.view_transforms import VIEW_TRANSFORMS
from unmix_plugin.viewer.session import Session

if TYPE_CHECKING:
    import viser

_TITLES = {layer.title: name for name, layer in LAYERS.items()}
_TRANSFORMS = {title: name for name, title in VIEW_TRANSFORMS.items()}
_NO_INDEX = "none for these bands"


class LayerPanel:
    """Chooses the layer; shows the controls that it has."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._settings = LayerSettings()
        self._gui = session.client.gui
        self._of_control: dict[str, list[Any]] = {}
        materials = session.materials()
        bands = materials.bands
        layer = self._gui.add_dropdown("layer", tuple(_TITLES), initial_value=LAYERS["rgb"].title)
        self._connect(layer, "layer", lambda: _TITLES.get(layer.value, layer.value))
        edges = bands.edges_nm
        self._low_nm, self._high_nm = float(edges[0]), float(edges[-1])
        middle = covered(bands, self._settings.wavelength_nm)
        wavelength = self._wavelength_slider("wavelength (nm)", middle)
        self._connect(wavelength, "wavelength_nm", lambda: wavelength.value, "wavelength")
        self._add_false_colour(bands.centers_nm.tolist())
        self._endmember = self._gui.add_dropdown("endmember", materials.names)
        self._connect(self._endmember, "endmember", self._chosen_endmember, "endmember")
        self._add_index(bands)
        self._add_scale()
        self._add_tone()
        background = self._gui.add_dropdown("background", tuple(BACKGROUNDS))
        self._connect(background, "background", lambda: background.value)
        self._show_controls()
        session.on_edit.append(self._show_names)

    def _show_names(self) -> None:
        """Endmembers may have other names."""
        names = self._session.materials().names
        if tuple(self._endmember.options) != names:
            self._endmember.options = names
            self._endmember.value = names[min(self._settings.endmember, len(names) - 1)]

    def _add_false_colour(self, centers_nm: list[float]) -> None:
        """Red, green and blue start where the longest, middle and shortest third of the bands have their middle."""
        count = len(centers_nm)
        starts = (centers_nm[5 * count // 6], centers_nm[count // 2], centers_nm[count // 6])
        sliders = [
            self._wavelength_slider(f"{name} (nm)", start)
            for name, start in zip(("red", "green", "blue"), starts, strict=True)
        ]
        self._settings = self._settings.changed("false_colour_nm", starts)
        for slider in sliders:
            self._connect(
                slider, "false_colour_nm", lambda: tuple(one.value for one in sliders), "false-colour"
            )

    def _wavelength_slider(self, label: str, start: float) -> viser.GuiSliderHandle[float]:
        step = max((self._high_nm - self._low_nm) / 500, 0.01)
        return self._gui.add_slider(label, self._low_nm, self._high_nm, round(step, 2), start)

    def _add_index(self, bands: Bands) -> None:
        """The named indices that the bands allow, and a formula that goes before them."""
        names = tuple(available_indices(bands))
        known = self._gui.add_dropdown("index", names or (_NO_INDEX,))
        formula = self._gui.add_text(
            "formula",
            "",
            hint="Such as (r650-r550)/(r650+r550), where r650 is the reflectance at 650 nm; empty: the index above.",
        )

        def chosen() -> str:
            return text(formula.value).strip() or (text(known.value) if names else "")

        self._settings = self._settings.changed("index", chosen())
        for control in (known, formula):
            self._connect(control, "index", chosen, "index")

    def _add_scale(self) -> None:
        colour_map = self._gui.add_dropdown("colours", COLOUR_MAPS)
        self._connect(colour_map, "colour_map", lambda: colour_map.value, "scale")
        is_own = self._gui.add_checkbox(
            "own range", False, hint="Choose the values at the ends of the colour map."
        )
        low = self._gui.add_number("low", 0.0, step=0.001)
        high = self._gui.add_number("high", 1.0, step=0.001)

        def value_range() -> tuple[Any, Any] | None:
            return (low.value, high.value) if is_own.value else None

        for control in (is_own, low, high):
            self._connect(control, "value_range", value_range, "scale")

    def _add_tone(self) -> None:
        exposure = self._gui.add_slider("exposure (stops)", *EXPOSURE_BOUNDS, 0.1, 0.0)
        self._connect(exposure, "exposure_ev", lambda: exposure.value, "tone")
        gamma = self._gui.add_slider("gamma", *GAMMA_BOUNDS, 0.05, 1.0)
        self._connect(gamma, "gamma", lambda: gamma.value, "tone")
        transform = self._gui.add_dropdown("tones", tuple(_TRANSFORMS))
        self._connect(transform, "view_transform", lambda: _TRANSFORMS.get(transform.value), "tone")

    def _connect(self, control: Any, setting: str, read: Callable[[], Any], kind: str | None = None) -> None:
        """Let a control change a setting, checked; show it only for layers that have its kind."""
        if kind is not None:
            self._of_control.setdefault(kind, []).append(control)

        def change() -> None:
            self._settings = self._settings.changed(setting, read())
            if setting == "layer":
                self._show_controls()
            self._session.restyle(self._settings)

        control.on_update(self._session.guarded(change))

    def _chosen_endmember(self) -> int:
        names = tuple(self._endmember.options)
        if self._endmember.value not in names:
            raise ConfigError(f"there is no endmember {str(self._endmember.value)[:40]!r}")
        return names.index(self._endmember.value)

    def _show_controls(self) -> None:
        wanted = layer_named(self._settings.layer).controls
        for kind, controls in self._of_control.items():
            for control in controls:
                control.visible = kind in wanted
