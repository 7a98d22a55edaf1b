"""The one painter: numbers of an output as colours with opacity, and what the colours mean.

Renders, videos, the viewer, page, report and evaluation show numbers through `paint` and nothing else, so that a place
has the same colour wherever it is shown.

Notation: `H x W` pixels, or some rows of a picture; `T` tiles, one for most outputs and one a class for fractions that
are not mixed; `K` classes. Light is linear RGB in sRGB primaries, 0 and up, 1 = the full scale of the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from unmix_plugin.engine.outputs import Output
from unmix_plugin.figures.look import BACKGROUNDS, NEUTRAL, Look
from unmix_plugin.figures.plotting import Colour, id_colours
from unmix_plugin.spectral.colour.conversion import agx, linear_to_srgb, srgb_to_linear
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.segmentation import NOTHING_ID

LIGHT_KINDS = frozenset({"srgb", "linear", "grey"})
"""Kinds of outputs that are light before black, hence multiplied by opacity already."""

_LEAST_OPACITY = 1e-6
_HATCH_PX, _HATCH_GREYS = 8, (0.55, 0.8)
"""Edge and sRGB of the stripes of what is seen and has no number."""


@dataclass(frozen=True)
class ColourScale:
    """How values become colours."""

    colour_map: str
    """A name of matplotlib's."""
    low: float
    high: float
    """Values at the two ends; those outside get the colours of the ends."""
    label: str
    """What the values are, with their unit."""


Legend: TypeAlias = ColourScale | tuple[tuple[str, tuple[float, ...]], ...] | str
"""What the colours of a picture mean: values, names with their sRGB colours, or one phrase."""


@dataclass(frozen=True)
class Painted:
    """Colours that are not multiplied by their opacity."""

    colours: Float64[Tensor, "H W T 3"]
    """[0, 1]: light as a display shows it, linear; of all else sRGB."""
    opacity: Float64[Tensor, "H W"]
    """[0, 1]."""
    is_light: bool
    """Whether colours are linear light, which is mixed with what lies behind as light is."""
    legend: Legend

    def over(self, background: float = NEUTRAL) -> Float64[Tensor, "H W T 3"]:
        """sRGB over an opaque grey of that sRGB value."""
        part = self.opacity[..., None, None]
        if not self.is_light:
            return self.colours * part + background * (1 - part)
        behind = float(srgb_to_linear(torch.tensor(background, dtype=torch.float64)))
        return linear_to_srgb(self.colours * part + behind * (1 - part))

    def picture(self, background: float = NEUTRAL) -> Float64[np.ndarray, "H W 3"]:
        """The first tile over an opaque grey, for figures."""
        return self.over(background)[:, :, 0].cpu().numpy()

    def rgba(self) -> UInt8[np.ndarray, "H W T 4"]:
        """sRGB with opacity as the fourth channel; black where nothing is."""
        colours = linear_to_srgb(self.colours) if self.is_light else self.colours
        alpha = as_bytes(self.opacity)[:, :, None, None]
        alpha = np.broadcast_to(alpha, (*colours.shape[:3], 1))
        return np.concatenate([np.where(alpha > 0, as_bytes(colours), np.uint8(0)), alpha], axis=-1)


def paint(
    output: Output,
    values: Tensor | np.ndarray,
    opacity: Float[Tensor | np.ndarray, "H W"],
    value_range: tuple[float, float] | None = None,
    look: Look = Look(),  # noqa: B008 - a frozen value
) -> Painted:
    """Numbers of an output as colours.

    Args:
        output: What the numbers are; of any kind but `channels` and `spectra`, which are no picture.
        values: (H, W, ...); numbers of something that is seen are hatched where they are undefined.
        opacity: How much of each pixel they fill, [0, 1].
        value_range: At the ends of the colour map, where neither the look nor the output says it.
        look: How the user has chosen to see it.
    """
    kind, given = output.kind, torch.as_tensor(values)
    part = torch.as_tensor(opacity).double().clamp(0, 1)
    legend = legend_of(output, value_range, look)
    if kind == "labels":
        palette = torch.from_numpy(id_palette(class_colours(output))).to(given.device)
        return Painted(palette[given.long()][:, :, None], (given != NOTHING_ID).double(), False, legend)
    numbers = given.double()
    if kind in LIGHT_KINDS and not isinstance(legend, ColourScale):
        light = srgb_to_linear(numbers.clamp(0, 1)) if kind == "srgb" else numbers
        light = light[..., None].expand(*light.shape, 3) if kind == "grey" else light
        shown = _display(light / part.clamp(min=_LEAST_OPACITY)[..., None], look)
        return Painted(shown[:, :, None], part, True, legend)
    if kind == "shares" and look.mixed:
        colours = torch.from_numpy(np.array(class_colours(output))[: numbers.shape[-1]]).to(numbers)
        named = enumerate(map(tuple, colours.tolist()))
        legend = output.classes or tuple((f"{output.title} {index}", colour) for index, colour in named)
        fractions = numbers / numbers.sum(dim=-1, keepdim=True).clamp(min=_LEAST_OPACITY)
        return Painted((fractions @ colours)[:, :, None], part, False, legend)
    if not isinstance(legend, ColourScale):
        shown = (numbers + 1) / 2 if kind == "vectors" else numbers
        return Painted(shown.clamp(0, 1)[:, :, None], part, False, legend)
    tiles = numbers if kind == "shares" else numbers[..., None]
    if kind == "grey" or output.is_premultiplied:
        tiles = tiles / part.clamp(min=_LEAST_OPACITY)[..., None]
    is_known = tiles.isfinite().all(dim=-1)
    is_hatched = ~is_known & (part >= OCCUPIED_ACCUMULATION)
    height, width = part.shape
    rows, columns = torch.arange(height, device=part.device)[:, None], torch.arange(width, device=part.device)
    stripes = torch.where((rows + columns) % _HATCH_PX < _HATCH_PX // 2, *_HATCH_GREYS).to(tiles)
    colours = torch.where(is_hatched[..., None, None], stripes[..., None, None], _mapped(tiles, legend))
    return Painted(colours, part * (is_known | is_hatched), False, legend)


def legend_of(output: Output, value_range: tuple[float, float] | None, look: Look) -> Legend:
    """What the colours of a picture mean; `value_range` where neither the look nor the output says it."""
    if is_scaled(output, look):
        return scale_of(output, value_range, look)
    if output.kind in ("labels", "shares") and output.classes:
        return output.classes
    what = output.legend or output.what
    return f"{what}; red, green, blue: x, y, z from -1 to 1" if output.kind == "vectors" else what


def scale_of(
    output: Output,
    value_range: tuple[float, float] | None = None,
    look: Look = Look(),  # noqa: B008 - a frozen value
) -> ColourScale:
    """The scale that an output's values are painted by; `value_range` where neither the look nor the output says it."""
    ends = look.value_range or output.value_range or value_range
    assert ends is not None, output.name
    return ColourScale(look.colour_map or output.colour_map, *ends, output.label_with_unit)


def is_scaled(output: Output, look: Look) -> bool:
    """Whether an output's colours are a scale of values."""
    if output.kind == "grey":
        return look.colour_map is not None
    return output.kind == "map" or (output.kind == "shares" and not look.mixed)


def needs_range(output: Output, look: Look) -> bool:
    """Whether only the views tell between which values an output's colours go."""
    return is_scaled(output, look) and output.value_range is None and look.value_range is None


def describe(
    output: Output, value_range: tuple[float, float] | None, look: Look, *, is_opaque: bool = False
) -> str:
    """What an output's colours mean, in pictures with opacity or in opaque ones, for people."""
    behind = look.background or ("grey" if is_opaque else None)
    if behind is None:
        text = output.described(", transparent where nothing is")
    else:
        text = output.described(f" on {'light grey' if behind == 'grey' else behind}")
    legend = legend_of(output, value_range, look)
    if not isinstance(legend, ColourScale):
        return text
    return f"{text}; colours: {legend.colour_map} from {legend.low:.6g} to {legend.high:.6g}"


def background_of(look: Look) -> float:
    """sRGB grey that opaque pictures lie over."""
    return BACKGROUNDS[look.background or "grey"]


def as_bytes(values: Float[Tensor, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Values in [0, 1] as 8-bit numbers on the CPU; others are cut."""
    return (values.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def id_palette(colours: Sequence[Colour] | Float64[np.ndarray, "K 3"]) -> Float64[np.ndarray, "256 3"]:
    """sRGB of each id, neutral grey for those without a colour."""
    palette = np.full((256, 3), NEUTRAL)
    palette[: len(colours)] = np.asarray(colours).reshape(-1, 3)
    return palette


def class_colours(output: Output) -> tuple[Colour, ...] | Float64[np.ndarray, "K 3"]:
    """sRGB of each class of labels or fractions: its own, or any that differs from its neighbours'."""
    return tuple(colour for _, colour in output.classes) if output.classes else id_colours()


@lru_cache(maxsize=16)
def colour_table(colour_map: str) -> Float64[np.ndarray, "256 3"]:
    """The colours of one of matplotlib's maps from low to high."""
    from matplotlib import colormaps

    return colormaps[colour_map](np.arange(256))[:, :3]


def scale_strip(scale: ColourScale, width: int, height: int) -> Float64[np.ndarray, "H W 3"]:
    """The colours of a scale from left to right, sRGB."""
    levels = np.linspace(0, 255, width).round().astype(int)
    return np.repeat(colour_table(scale.colour_map)[levels][None], height, axis=0)


def _mapped(values: Float64[Tensor, "H W T"], scale: ColourScale) -> Float64[Tensor, "H W T 3"]:
    """Values in the colours of a scale, as matplotlib counts its levels; undefined ones are the neutral grey."""
    table = torch.from_numpy(colour_table(scale.colour_map)).to(values)
    fraction = (values - scale.low) / (scale.high - scale.low)
    levels = (fraction.nan_to_num(0.0).clamp(0, 1) * len(table)).long().clamp(max=len(table) - 1)
    return torch.where(values.isnan()[..., None], NEUTRAL, table[levels])


def _display(light: Float64[Tensor, "H W 3"], look: Look) -> Float64[Tensor, "H W 3"]:
    """Light as a display shows it, in [0, 1], still linear; highlights are cut at white, or compressed by 16.5 stops as
    film does, and gamma is last."""
    exposed = light * 2.0**look.exposure
    if look.highlights == "cut" and math.isclose(look.gamma, 1.0):
        return exposed.clamp(0, 1)
    shown = agx(exposed) if look.highlights == "kept" else linear_to_srgb(exposed.clamp(0, 1))
    return srgb_to_linear(shown.clamp(0, 1) ** (1 / look.gamma))
