"""How a user has chosen to see a rendered view: what is shown, and in which colours and tones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from unmix_plugin.figures.look import BACKGROUNDS, Background, ColourMap, Highlights, Look
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.viewer.page import choice, number, text

HIGHLIGHTS: dict[Highlights, str] = {
    "cut": "cut at white (sRGB, exact)",
    "kept": "kept (AgX, as film does)",
}
"""Names and what users read."""

COLOUR_MAPS: tuple[ColourMap, ...] = get_args(ColourMap)

EXPOSURE_BOUNDS, GAMMA_BOUNDS = (-8.0, 8.0), (0.2, 5.0)
_WAVELENGTH_BOUNDS = (1.0, 1e5)
_VALUE_BOUNDS = (-1e6, 1e6)
_LONGEST_INDEX = 1000
"""Letters that are kept: more than a formula may have, so that none becomes another one by being cut."""


@dataclass(frozen=True)
class LayerSettings(Look):
    """What is shown and how; every value lies within bounds. A picture is what `unmix-render` paints with this look."""

    background: Background = "grey"
    colour_map: ColourMap = "viridis"
    mixed: bool = True
    layer: str = "rgb"
    wavelength_nm: float = 550.0
    """Shown by the layer `band`."""
    false_colour_nm: tuple[float, float, float] = (650.0, 550.0, 450.0)
    """Shown as red, green, blue by the layer `false-colour`."""
    endmember: int = 0
    """Shown by the layer `abundance`."""
    index: str = ""
    """Shown by the layer `index`: a name or a formula, as the output `index:` takes it; empty where none is chosen."""

    def changed(self, name: str, value: Any) -> LayerSettings:
        """With one setting as a browser sent it, brought within its bounds; what makes no sense changes nothing."""
        return replace(self, **{name: _CHECKS[name](value, getattr(self, name))})


def first_settings(bands: Bands) -> LayerSettings:
    """What a page shows at first; false colour from the middles of the long, middle and short third of the bands."""
    centers_nm, count = bands.centers_nm.tolist(), len(bands)
    starts = (centers_nm[5 * count // 6], centers_nm[count // 2], centers_nm[count // 6])
    wavelength_nm = covered(bands, LayerSettings.wavelength_nm)
    index = next(iter(available_indices(bands)), "")
    return LayerSettings(wavelength_nm=wavelength_nm, false_colour_nm=starts, index=index)


def _checked_range(value: Any, before: tuple[float, float] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    try:
        low, high = (number(part, *_VALUE_BOUNDS, fallback=math.nan) for part in value)
    except (TypeError, ValueError):
        return before
    return (low, high) if low < high else before


def _checked_wavelengths(value: Any, before: tuple[float, float, float]) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or len(value) != 3:
        return before
    return tuple(
        number(one, *_WAVELENGTH_BOUNDS, fallback=old) for one, old in zip(value, before, strict=True)
    )


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
    "exposure": lambda value, before: number(value, *EXPOSURE_BOUNDS, fallback=before),
    "gamma": lambda value, before: number(value, *GAMMA_BOUNDS, fallback=before),
    "highlights": lambda value, before: choice(value, HIGHLIGHTS, before),
    "background": lambda value, before: choice(value, BACKGROUNDS, before),
}


def covered(bands: Bands, wavelength_nm: float) -> float:
    """The wavelength, or the nearest that some band covers."""
    low, high = bands.ranges_nm.T
    within = np.clip(wavelength_nm, low, high)
    return float(within[np.argmin(abs(within - wavelength_nm))])
