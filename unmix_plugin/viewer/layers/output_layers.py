"""Layers that follow from the outputs that a scene names: each is painted by its kind.

Notation: `H x W` pixels; pictures are sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from unmix_plugin.engine.outputs import Output, OutputKind
from unmix_plugin.spectral.colour.conversion import srgb_to_linear
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.viewer.layers.layer import Layer
from unmix_plugin.viewer.layers.layer_aids import LayerAids
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.painting import (
    ColourMapLegend,
    Legend,
    Picture,
    SwatchLegend,
    TextLegend,
    colour_table,
    over_background,
    paint_values,
    tone_mapped,
)
from unmix_plugin.viewer.rendering.reference import percentile_range

_Paint = Callable[[Tensor, RenderedView, LayerSettings, Output], tuple[Picture, Legend]]


def layer_of(output: Output) -> Layer:
    """The layer of an output of a kind that can be painted."""
    paint, controls = _PAINTERS[output.kind]

    def paint_output(
        frame: RenderedView, settings: LayerSettings, _: LayerAids | None
    ) -> tuple[Picture, Legend]:
        return paint(frame[output.name], frame, settings, output)

    return Layer(output.name, output.title, paint_output, controls, output.kind == "labels")


def _paint_srgb(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    return _paint_linear(srgb_to_linear(values.clamp(0, 1)), frame, settings, output)


def _paint_linear(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    return tone_mapped(values, frame.coverage, settings), TextLegend(output.what)


def _paint_picture(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    return over_background(values.clamp(0, 1), frame.opacity, settings), TextLegend(output.what)


def _paint_vectors(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    legend = TextLegend(f"{output.what}; red, green, blue: x, y, z from -1 to 1")
    return over_background(((values + 1) / 2).clamp(0, 1), frame.opacity, settings), legend


def _paint_map(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    is_known = values.isfinite()
    seen = values[is_known & (frame.opacity > OCCUPIED_ACCUMULATION)]
    scale = settings.value_range or output.value_range or percentile_range(seen)
    picture = paint_values(values, scale, settings.colour_map)
    legend = ColourMapLegend(settings.colour_map, *scale, output.what)
    # Opacity itself is shown everywhere, also where there is little of it.
    opacity = is_known.to(picture) if output.name == "accumulation" else frame.opacity * is_known
    return over_background(picture, opacity, settings), legend


def _paint_labels(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    palette = _palette().to(frame.opacity)
    is_something = (values != NOTHING_ID).to(palette)
    return over_background(palette[values.long()], is_something, settings), TextLegend(output.what)


def _paint_shares(
    values: Tensor, frame: RenderedView, settings: LayerSettings, output: Output
) -> tuple[Picture, Legend]:
    """The colours that labels have, mixed by the shares."""
    palette = _palette()[: values.shape[-1]].to(values)
    shares = values / values.sum(dim=-1, keepdim=True).clamp(min=1e-6)
    names = (f"{output.title} {number}" for number in range(len(palette)))
    legend = SwatchLegend(tuple(zip(names, map(tuple, palette.tolist()), strict=True)))
    return over_background(shares @ palette, frame.opacity, settings), legend


def _palette() -> Tensor:
    """A colour for each id, (256, 3); those of neighbours are far apart."""
    return colour_table("turbo")[torch.arange(256) * 389 % 1024]


_PAINTERS: dict[OutputKind, tuple[_Paint, frozenset[str]]] = {
    "srgb": (_paint_srgb, frozenset({"tone"})),
    "linear": (_paint_linear, frozenset({"tone"})),
    "picture": (_paint_picture, frozenset()),
    "grey": (_paint_map, frozenset({"scale"})),
    "map": (_paint_map, frozenset({"scale"})),
    "labels": (_paint_labels, frozenset()),
    "shares": (_paint_shares, frozenset()),
    "vectors": (_paint_vectors, frozenset()),
}

PAINTED_KINDS = frozenset(_PAINTERS)
"""Kinds of outputs that can be painted without knowing more of them."""
