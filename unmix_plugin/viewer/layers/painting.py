"""How values and light become pictures, as a user has chosen to see them, and what the colours mean.

Notation: pictures are (H, W, 3) sRGB in [0, 1]; `light` is linear RGB in sRGB primaries, 0 and up, 1 = the
sensor's full scale before exposure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from html import escape
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import agx, linear_to_srgb, srgb_to_linear
from unmix_plugin.spectral.maps.indices import available_indices
from unmix_plugin.viewer.page import BLOCK_STYLE, choice, number, paragraph, swatches, text

_ViewTransform = Literal["srgb", "agx"]
VIEW_TRANSFORMS: dict[_ViewTransform, str] = {
    "srgb": "sRGB (exact up to white)",
    "agx": "AgX (keeps highlights)",
}
"""Names and what users read."""

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
    view_transform: _ViewTransform = "srgb"
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
    "exposure_ev": lambda value, before: number(value, *EXPOSURE_BOUNDS, fallback=before),
    "gamma": lambda value, before: number(value, *GAMMA_BOUNDS, fallback=before),
    "view_transform": lambda value, before: choice(value, VIEW_TRANSFORMS, before),
    "background": lambda value, before: choice(value, BACKGROUNDS, before),
}


Picture: TypeAlias = Float[Tensor, "H W 3"]

_LEVELS = 1024


@dataclass(frozen=True)
class ColourMapLegend:
    """Values and their colours."""

    colour_map: str
    low: float
    high: float
    label: str


@dataclass(frozen=True)
class SwatchLegend:
    """Names and their sRGB colours."""

    entries: tuple[tuple[str, tuple[float, ...]], ...]


@dataclass(frozen=True)
class TextLegend:
    """One phrase."""

    text: str


Legend: TypeAlias = ColourMapLegend | SwatchLegend | TextLegend


def _to_display(
    light: Float[Tensor, "*pixels 3"], exposure_ev: float, gamma: float, transform: _ViewTransform
) -> Float[Tensor, "*pixels 3"]:
    """Light as a display shows it: `srgb` clips at white, `agx` compresses 16.5 stops, as film does; gamma is last."""
    exposed = light * 2.0**exposure_ev
    shown = agx(exposed) if transform == "agx" else linear_to_srgb(exposed.clamp(0, 1))
    shown = shown.clamp(0, 1)
    return shown if math.isclose(gamma, 1.0) else shown.pow(1 / gamma)


def paint_values(values: Float[Tensor, "H W"], scale: tuple[float, float], colour_map: str) -> Picture:
    """Values as colours; those outside the scale get the colours of its ends."""
    fraction = (values - scale[0]) / (scale[1] - scale[0])
    levels = (fraction.nan_to_num(0.0).clamp(0, 1) * (_LEVELS - 1) + 0.5).long()
    return colour_table(colour_map).to(values)[levels]


@lru_cache(maxsize=len(COLOUR_MAPS))
def colour_table(colour_map: str) -> Float[Tensor, "levels 3"]:
    """sRGB colours of a map from its low to its high end."""
    from matplotlib import colormaps

    return torch.as_tensor(colormaps[colour_map](np.linspace(0, 1, _LEVELS))[:, :3], dtype=torch.float32)


def over_background(picture: Picture, opacity: Float[Tensor, "H W"], settings: LayerSettings) -> Picture:
    """A picture that is not multiplied by its opacity, laid over the background."""
    part = opacity.clamp(0, 1)[..., None]
    return picture * part + BACKGROUNDS[settings.background] * (1 - part)


def tone_mapped(
    light: Float[Tensor, "H W 3"], opacity: Float[Tensor, "H W"], settings: LayerSettings
) -> Picture:
    """Linear light seen on black as a display shows it, over the background; edges are mixed in linear light."""
    part = opacity.clamp(0, 1)[..., None]
    solid = _to_display(
        light / part.clamp(min=1e-3), settings.exposure_ev, settings.gamma, settings.view_transform
    )
    behind = BACKGROUNDS[settings.background]
    behind_linear = float(srgb_to_linear(torch.tensor(behind)))
    mixed = linear_to_srgb(srgb_to_linear(solid) * part + behind_linear * (1 - part))
    return mixed.clamp(0, 1)


def as_bytes(picture: Picture) -> UInt8[np.ndarray, "H W 3"]:
    """A picture as 8-bit values on the CPU."""
    return (picture * 255 + 0.5).clamp(0, 255).to(torch.uint8).cpu().numpy()


def legend_html(shown: Legend) -> str:
    """What the colours of a picture mean."""
    if isinstance(shown, TextLegend):
        return paragraph(shown.text)
    if isinstance(shown, SwatchLegend):
        return swatches(shown.entries)
    table = colour_table(shown.colour_map)
    chosen = np.linspace(0, len(table) - 1, 17).round().astype(int)
    stops = ",".join(css_colour(table[index].tolist()) for index in chosen)
    return (
        f'<div style="{BLOCK_STYLE}"><div>{escape(shown.label)}</div>'
        f'<div style="height:0.9em;background:linear-gradient(to right,{stops})"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{shown.low:.4g}</span><span>{(shown.low + shown.high) / 2:.4g}</span>"
        f"<span>{shown.high:.4g}</span></div></div>"
    )
