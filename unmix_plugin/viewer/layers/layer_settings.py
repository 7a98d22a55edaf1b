"""What a user has chosen to see."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.viewer.inputs import choice, number, text
from unmix_plugin.viewer.layers.view_transforms import VIEW_TRANSFORMS, ViewTransform

BACKGROUNDS = {"grey": 0.92, "white": 1.0, "black": 0.0}
"""sRGB value of what shows nothing; grey is that of the figures."""

COLOUR_MAPS = ("viridis", "magma", "inferno", "cividis", "turbo", "coolwarm", "gray")
"""As matplotlib names them."""

EXPOSURE_BOUNDS, GAMMA_BOUNDS = (-8.0, 8.0), (0.2, 5.0)
_WAVELENGTH_BOUNDS = (1.0, 1e5)
_VALUE_BOUNDS = (-1e6, 1e6)
_LONGEST_INDEX = 1000
"""Letters that are kept: more than a formula may have, so that none becomes another one by being cut."""


@dataclass(frozen=True)
class LayerSettings:
    """What is shown and how; every value lies within bounds."""

    layer: str = "rgb"
    wavelength_nm: float = 550.0
    """Shown by the layer `band`."""
    false_colour_nm: tuple[float, float, float] = (650.0, 550.0, 450.0)
    """Shown as red, green, blue by the layer `false-colour`."""
    endmember: int = 0
    """Shown by the layer `abundance`."""
    index: str = ""
    """Shown by the layer `index`: a name or a formula, as the output `index:` takes it; empty where none is chosen."""
    colour_map: str = "viridis"
    value_range: tuple[float, float] | None = None
    """Values at the ends of the colour map; None for the layer's own."""
    exposure_ev: float = 0.0
    """Stops."""
    gamma: float = 1.0
    view_transform: ViewTransform = "srgb"
    background: str = "grey"
    """Where nothing is seen; one of `BACKGROUNDS`."""

    def changed(self, name: str, value: Any) -> LayerSettings:
        """With one setting as a browser sent it, brought within its bounds; what makes no sense changes nothing."""
        return replace(self, **{name: _CHECKS[name](value, getattr(self, name))})


def first_settings(bands: Bands) -> LayerSettings:
    """What a page shows at first; false colour from the middles of the long, middle and short third of the bands."""
    centers_nm, count = bands.centers_nm.tolist(), len(bands)
    starts = (centers_nm[5 * count // 6], centers_nm[count // 2], centers_nm[count // 6])
    return LayerSettings(false_colour_nm=starts, index=next(iter(available_indices(bands)), ""))


def _checked_range(value: Any, before: tuple[float, float] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    try:
        low, high = (number(part, *_VALUE_BOUNDS, fallback=math.nan) for part in value)
    except (TypeError, ValueError):
        return before
    return (low, high) if low < high else before


def _checked_wavelengths(value: Any, before: tuple[float, float, float]) -> tuple[float, float, float]:
    try:
        red, green, blue = value
    except (TypeError, ValueError):
        return before
    checked = [
        number(one, *_WAVELENGTH_BOUNDS, fallback=old)
        for one, old in zip((red, green, blue), before, strict=True)
    ]
    return (checked[0], checked[1], checked[2])


_CHECKS: dict[str, Callable[[Any, Any], Any]] = {
    "layer": lambda value, before: value if isinstance(value, str) and len(value) < 100 else before,
    "wavelength_nm": lambda value, before: number(value, *_WAVELENGTH_BOUNDS, fallback=before),
    "false_colour_nm": _checked_wavelengths,
    "endmember": lambda value, before: int(number(value, 0, 254, fallback=before)),
    "index": lambda value, before: (
        " ".join(text(value).split())[:_LONGEST_INDEX] if isinstance(value, str) else before
    ),
    "colour_map": lambda value, before: choice(value, COLOUR_MAPS, before),
    "value_range": _checked_range,
    "exposure_ev": lambda value, before: number(value, *EXPOSURE_BOUNDS, fallback=before),
    "gamma": lambda value, before: number(value, *GAMMA_BOUNDS, fallback=before),
    "view_transform": lambda value, before: choice(value, VIEW_TRANSFORMS, before),
    "background": lambda value, before: choice(value, BACKGROUNDS, before),
}
