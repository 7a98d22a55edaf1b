"""Outputs of a render as colours, and the legends of these: what a PNG or a video shows.

A picture has tiles side by side, one for most outputs and one for each endmember for abundances. For a PNG, colours
come with opacity, by which they are not multiplied; for a video, they are laid over the neutral grey.

Notation: `h x W` pixels, some rows of an image; `T` tiles, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, UInt8

from unmix_plugin.engine.printing import plot_text
from unmix_plugin.engine.registry import Output
from unmix_plugin.figures.pictures import (
    ColourScale,
    draw_legend_entries,
    id_palette,
    legend_height,
    over_neutral,
    paint,
    premultiplied_over_neutral,
)
from unmix_plugin.figures.plotting import (
    Colour,
    draw_colour_bar,
    figure_bytes,
    id_colours,
    page_in_inches,
)
from unmix_plugin.formats.files import csv_bytes, eight_bits
from unmix_plugin.spectral.colour.srgb import decode_srgb, encode_srgb
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.run_materials import endmember_colours

LIGHT_KINDS = frozenset({"srgb", "linear", "grey"})
"""Outputs seen on black, hence multiplied by opacity already."""


@dataclass(frozen=True)
class Palette:
    """The colours of a render, the same in all its pictures."""

    names: tuple[str, ...]
    """Of the endmembers; none where the scene has no materials."""
    colours: Float64[np.ndarray, "K 3"]
    """sRGB colours that stand for the endmembers, or for ids where there are none."""
    scales: dict[str, ColourScale]
    """Scales that depend on the views, by output."""

    @staticmethod
    def of(materials: Materials | None, surveyed: dict[str, ColourScale]) -> Palette:
        """The palette of a scene, with the scales that depend on the views."""
        if materials is None:
            return Palette((), id_colours(), surveyed)
        return Palette(materials.names, endmember_colours(materials), surveyed)

    def by_id(self, output: Output) -> Float64[np.ndarray, "256 3"]:
        """Colour of each id, neutral grey for those that stand for nothing."""
        own = [colour for _, colour in output.classes] if output.classes else self.colours
        return id_palette(dict(enumerate(own)))

    def scale(self, output: Output) -> ColourScale | None:
        """The scale of an output's colours; None where its colours are not a scale."""
        if output.name in self.scales or output.value_range is None:
            return self.scales.get(output.name)
        return scale_of(output, *output.value_range)

    def describe(self, output: Output, is_opaque: bool = False) -> str:
        """What an output's colours mean, in pictures with opacity or in opaque ones, over the neutral grey."""
        behind = " on light grey" if is_opaque else ", transparent where nothing is"
        what = output.described(behind)
        scale = self.scale(output)
        if scale is None:
            return what
        return f"{what}; colours: {scale.colour_map} from {scale.low:.6g} to {scale.high:.6g}"


def scale_of(output: Output, low: float, high: float) -> ColourScale:
    """The output's colour map between two values."""
    return ColourScale(output.colour_map, low, high, output.label_with_unit)


def opaque_tiles(
    output: Output, values: np.ndarray, opacity: Float[np.ndarray, "h W"], palette: Palette
) -> UInt8[np.ndarray, "h W T 3"]:
    """Colours over the neutral grey."""
    if output.kind in LIGHT_KINDS:
        return _over_grey(_linear(output, values), opacity)
    tiles = _symbols(output, values, opacity, palette)
    if output.name == "accumulation":
        return eight_bits(tiles)
    flat = [over_neutral(tiles[:, :, index], opacity) for index in range(tiles.shape[2])]
    return eight_bits(np.stack(flat, axis=2))


def opaque_band(
    radiance: Float[np.ndarray, "h W"], opacity: Float[np.ndarray, "h W"]
) -> UInt8[np.ndarray, "h W 1 3"]:
    """One band of a spectrum on black as grey, over the neutral grey."""
    return _over_grey(_grey(np.clip(np.asarray(radiance, dtype=np.float64), 0, 1)), opacity)


def transparent_tiles(
    output: Output, values: np.ndarray, opacity: Float[np.ndarray, "h W"], palette: Palette
) -> UInt8[np.ndarray, "h W T 4"]:
    """Colours with opacity as the fourth channel; black where nothing is."""
    if output.kind in LIGHT_KINDS:
        straight = _linear(output, values) / np.maximum(opacity, 1e-6)[..., None]
        tiles = encode_srgb(np.clip(straight, 0, 1))[:, :, None]
    else:
        tiles = _symbols(output, values, opacity, palette)
    alpha = np.ones_like(opacity) if output.name == "accumulation" else opacity
    alpha = np.broadcast_to(eight_bits(alpha)[:, :, None, None], (*tiles.shape[:3], 1))
    return np.concatenate([np.where(alpha > 0, eight_bits(tiles), np.uint8(0)), alpha], axis=-1)


def _symbols(
    output: Output, values: np.ndarray, opacity: Float[np.ndarray, "h W"], palette: Palette
) -> Float[np.ndarray, "h W T 3"]:
    """sRGB colours that are not multiplied by opacity."""
    kind = output.kind
    if kind == "picture":
        return np.asarray(values, dtype=np.float64)[:, :, None]
    if kind == "vectors":
        return (0.5 + 0.5 * np.asarray(values, dtype=np.float64))[:, :, None]
    if kind == "labels":
        return palette.by_id(output)[values][:, :, None]
    scale = palette.scale(output)
    assert scale is not None, output.name
    if output.name == "abundances":  # of what is seen: that a pixel is half covered is shown by its opacity
        values = values / np.maximum(opacity, 1e-6)[..., None]
    maps = values[..., None] if kind == "map" else values
    return np.stack([paint(np.asarray(one, np.float64), scale) for one in np.moveaxis(maps, -1, 0)], axis=2)


def _linear(output: Output, values: np.ndarray) -> Float64[np.ndarray, "h W 3"]:
    """Linear light on black, in [0, 1]."""
    light = np.clip(np.asarray(values, dtype=np.float64), 0, 1)
    if output.kind == "srgb":
        return decode_srgb(light)
    return _grey(light) if output.kind == "grey" else light


def _grey(light: Float64[np.ndarray, "h W"]) -> Float64[np.ndarray, "h W 3"]:
    return np.repeat(light[..., None], 3, axis=-1)


def _over_grey(
    linear: Float64[np.ndarray, "h W 3"], opacity: Float[np.ndarray, "h W"]
) -> UInt8[np.ndarray, "h W 1 3"]:
    return eight_bits(premultiplied_over_neutral(linear, opacity))[:, :, None]


_WIDTH, _BAR_ROW, _MARGIN = 5.2, 0.66, 0.16
"""Inches."""
_LONGEST_NAME = 30
_FONT_PT = 9


def legend_csv(classes: Iterable[tuple[str, Colour]], nothing: Colour | None = None) -> bytes:
    """What ids mean, counted from 0: `id,name,red,green,blue`, sRGB 0 to 255; and `nothing`, if it has a colour."""
    named = [(index, name, colour) for index, (name, colour) in enumerate(classes)]
    named += [] if nothing is None else [(NOTHING_ID, "nothing", nothing)]
    rows = [[index, name, *np.round(255 * np.asarray(colour)).astype(int)] for index, name, colour in named]
    return csv_bytes([["id", "name", "red", "green", "blue"], *rows])


def draw_legend(output: Output, palette: Palette) -> bytes:
    """The legend of an output as a PNG."""
    scale, width = palette.scale(output), _WIDTH - 2 * _MARGIN
    shown = output.classes or zip(palette.names, palette.colours, strict=False)
    shown = shown if output.kind in ("labels", "shares") else ()
    names = [(name[:_LONGEST_NAME], colour) for name, colour in shown]
    names_height = legend_height(names, width) if names else 0.0
    height = 2 * _MARGIN + (0.0 if scale is None else _BAR_ROW) + names_height
    figure, page = page_in_inches(_WIDTH, height)
    if scale is not None:
        box = (_MARGIN, _MARGIN + names_height + 0.3, width, 0.14)
        drawn = draw_colour_bar(page, box, scale.colour_map, (scale.low, scale.high), "horizontal")
        drawn.ax.tick_params(labelsize=_FONT_PT - 1, length=2, pad=2)
        drawn.ax.set_title(plot_text(f"{output.name}: {scale.label}"), fontsize=_FONT_PT, loc="left", pad=3)
    draw_legend_entries(page, names, (_MARGIN, _MARGIN + names_height), width)
    return figure_bytes(figure)
