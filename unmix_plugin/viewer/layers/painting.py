"""Values and light as pictures over a background, and what legends say.

Notation: pictures are (H, W, 3) sRGB in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.spectral.colour.conversion import linear_to_srgb, srgb_to_linear
from unmix_plugin.viewer.layers.layer_settings import BACKGROUNDS, COLOUR_MAPS, LayerSettings
from unmix_plugin.viewer.layers.view_transforms import to_display

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
    solid = to_display(
        light / part.clamp(min=1e-3), settings.exposure_ev, settings.gamma, settings.view_transform
    )
    behind = BACKGROUNDS[settings.background]
    behind_linear = float(srgb_to_linear(torch.tensor(behind)))
    mixed = linear_to_srgb(srgb_to_linear(solid) * part + behind_linear * (1 - part))
    return mixed.clamp(0, 1)


def as_bytes(picture: Picture) -> UInt8[np.ndarray, "H W 3"]:
    """A picture as 8-bit values on the CPU."""
    return (picture * 255 + 0.5).clamp(0, 255).to(torch.uint8).cpu().numpy()
