"""What can be shown of a rendered view, and what the colours mean.

A layer is a function from a view to a picture and its legend. Titles, kinds and ranges are those of the table of
outputs; here is how they are painted.

Notation: pictures are (H, W, 3) sRGB in [0, 1]; what is transparent shows the background. `light` is linear RGB in sRGB
primaries, 0 and up, 1 = the full scale of the sensor before exposure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from html import escape
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.engine.registry import Output, OutputKind
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.pictures import NEUTRAL, ColourScale
from unmix_plugin.figures.plotting import css_colour, id_colours
from unmix_plugin.spectral.colour.conversion import (
    agx,
    band_composite_matrix,
    describe_colour,
    linear_to_srgb,
    rgb_matrix,
    srgb_to_linear,
)
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.outputs import FAMILIES, OUTPUTS, MaterialView, usual_range
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.reflectance_maps import parse_reflectance_map
from unmix_plugin.viewer.page import BLOCK_STYLE, paragraph, swatches
from unmix_plugin.viewer.rendering.aids import LayerAids
from unmix_plugin.viewer.rendering.settings import (
    BACKGROUNDS,
    COLOUR_MAPS,
    LayerSettings,
    ViewTransform,
    covered,
)

_Picture: TypeAlias = Float[Tensor, "H W 3"]

_LEVELS = 1024

Legend: TypeAlias = ColourScale | tuple[tuple[str, tuple[float, ...]], ...] | str
"""What the colours of a picture mean: values, names with their sRGB colours, or one phrase."""


def _to_display(
    light: Float[Tensor, "*pixels 3"], exposure_ev: float, gamma: float, transform: ViewTransform
) -> Float[Tensor, "*pixels 3"]:
    """Light as a display shows it: `srgb` clips at white, `agx` compresses 16.5 stops, as film does; gamma is last."""
    exposed = light * 2.0**exposure_ev
    shown = agx(exposed) if transform == "agx" else linear_to_srgb(exposed.clamp(0, 1))
    shown = shown.clamp(0, 1)
    return shown if math.isclose(gamma, 1.0) else shown.pow(1 / gamma)


def _paint_values(values: Float[Tensor, "H W"], scale: tuple[float, float], colour_map: str) -> _Picture:
    """Values as colours; those outside the scale get the colours of its ends."""
    fraction = (values - scale[0]) / (scale[1] - scale[0])
    levels = (fraction.nan_to_num(0.0).clamp(0, 1) * (_LEVELS - 1) + 0.5).long()
    return _colour_table(colour_map).to(values)[levels]


@lru_cache(maxsize=len(COLOUR_MAPS))
def _colour_table(colour_map: str) -> Float[Tensor, "levels 3"]:
    from matplotlib import colormaps

    return torch.as_tensor(colormaps[colour_map](np.linspace(0, 1, _LEVELS))[:, :3], dtype=torch.float32)


def _over_background(picture: _Picture, opacity: Float[Tensor, "H W"], settings: LayerSettings) -> _Picture:
    """A picture that is not multiplied by its opacity, laid over the background."""
    part = opacity.clamp(0, 1)[..., None]
    return picture * part + BACKGROUNDS[settings.background] * (1 - part)


def _tone_mapped(
    light: Float[Tensor, "H W 3"], opacity: Float[Tensor, "H W"], settings: LayerSettings
) -> _Picture:
    """Linear light seen on black as a display shows it, over the background; edges are mixed in linear light."""
    part = opacity.clamp(0, 1)[..., None]
    solid = _to_display(
        light / part.clamp(min=1e-3), settings.exposure_ev, settings.gamma, settings.view_transform
    )
    behind = BACKGROUNDS[settings.background]
    behind_linear = float(srgb_to_linear(torch.tensor(behind)))
    mixed = linear_to_srgb(srgb_to_linear(solid) * part + behind_linear * (1 - part))
    return mixed.clamp(0, 1)


def as_bytes(picture: _Picture) -> UInt8[np.ndarray, "H W 3"]:
    """A picture as 8-bit values on the CPU."""
    return (picture * 255 + 0.5).clamp(0, 255).to(torch.uint8).cpu().numpy()


def legend_html(shown: Legend) -> str:
    """What the colours of a picture mean."""
    if isinstance(shown, str):
        return paragraph(shown)
    if not isinstance(shown, ColourScale):
        return swatches(shown)
    table = _colour_table(shown.colour_map)
    chosen = np.linspace(0, len(table) - 1, 17).round().astype(int)
    stops = ",".join(css_colour(table[index].tolist()) for index in chosen)
    return (
        f'<div style="{BLOCK_STYLE}"><div>{escape(shown.label)}</div>'
        f'<div style="height:0.9em;background:linear-gradient(to right,{stops})"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{shown.low:.4g}</span><span>{(shown.low + shown.high) / 2:.4g}</span>"
        f"<span>{shown.high:.4g}</span></div></div>"
    )


_Painter = Callable[[Any, LayerSettings, Any], tuple[_Picture, Legend]]
"""From a rendered view, of the kind of scene that has the layer, and what layers need of the run."""


@dataclass(frozen=True)
class _Layer:
    """A name, what users read, and the function that paints it."""

    name: str
    """As in outputs of renders, where there is such an output."""
    title: str
    paint: _Painter
    controls: frozenset[str]
    """Which of `wavelength`, `false-colour`, `endmember`, `index`, `tone`, `scale` apply."""
    is_labels: bool = False
    """Whether each colour stands for something of its own, so that pictures must not be compressed with loss."""


def layer_named(name: str, layers: Mapping[str, _Layer]) -> _Layer:
    """A layer by its name; a ConfigError if there is none."""
    if name not in layers:
        raise ConfigError(f"there is no layer named {name[:40]!r}; known: {', '.join(layers)}")
    return layers[name]


_TONE, _SCALE, _NONE = frozenset({"tone"}), frozenset({"scale"}), frozenset[str]()
_PAINTED_KINDS: dict[OutputKind, frozenset[str]] = {
    **dict.fromkeys(("srgb", "linear"), _TONE),
    **dict.fromkeys(("grey", "map"), _SCALE),
    **dict.fromkeys(("picture", "labels", "shares", "vectors"), _NONE),
}
"""Kinds of outputs that can be painted without knowing more of them, and the controls of their layers."""


def _layer_of(output: Output) -> _Layer:

    def paint(frame: RenderedView, settings: LayerSettings, _: LayerAids | None) -> tuple[_Picture, Legend]:
        values, opacity, kind = frame[output.name], frame.opacity, output.kind
        if kind in ("srgb", "linear"):
            light = values if kind == "linear" else srgb_to_linear(values.clamp(0, 1))
            return _tone_mapped(light, frame.coverage, settings), output.what
        if kind in ("grey", "map"):
            is_known = values.isfinite()
            seen = values[is_known & (opacity > OCCUPIED_ACCUMULATION)]
            # Opacity itself is shown everywhere, also where there is little of it.
            part = is_known.to(opacity) if output.name == "accumulation" else opacity * is_known
            scale = output.value_range or usual_range(seen)
            return _paint_scaled(values, part, settings, scale, output.what)
        palette = torch.from_numpy(id_colours()).to(opacity)
        if kind == "labels":
            names = [name for name, _ in output.classes]
            if names:
                palette = palette.new_tensor([colour for _, colour in output.classes])
            picture, legend = _paint_labels(values, settings, names, palette)
            return picture, legend if names else output.what
        if kind == "shares":
            palette = palette[: values.shape[-1]]
            shares = values / values.sum(dim=-1, keepdim=True).clamp(min=1e-6)
            legend = _swatches([f"{output.title} {number}" for number in range(len(palette))], palette)
            return _over_background(shares @ palette, opacity, settings), legend
        legend = output.what
        if kind == "vectors":
            values, legend = (values + 1) / 2, f"{legend}; red, green, blue: x, y, z from -1 to 1"
        return _over_background(values.clamp(0, 1), opacity, settings), legend

    return _Layer(output.name, output.title, paint, _PAINTED_KINDS[output.kind], output.kind == "labels")


def _paint_labels(
    ids: UInt8[Tensor, "H W"], settings: LayerSettings, names: Sequence[str], colours: Float[Tensor, "K 3"]
) -> tuple[_Picture, Legend]:
    """Each id in its colour, those without one in grey, and the background where nothing is."""
    palette = colours.new_full((256, 3), NEUTRAL)
    palette[: len(colours)] = colours
    picture = _over_background(palette[ids.long()], (ids != NOTHING_ID).to(colours), settings)
    return picture, _swatches(names, colours[: len(names)])


def _paint_scaled(
    values: Float[Tensor, "H W"],
    part: Float[Tensor, "H W"],
    settings: LayerSettings,
    scale: tuple[float, float],
    label: str,
) -> tuple[_Picture, Legend]:
    """Values in the colours of a scale, or of the user's own, over the background where they fill but a part."""
    shown = settings.value_range or scale
    picture = _paint_values(values, shown, settings.colour_map)
    return _over_background(picture, part, settings), ColourScale(settings.colour_map, *shown, label)


def _swatches(names: Sequence[str], colours: Float[Tensor, "K 3"]) -> Legend:
    return tuple(zip(names, map(tuple, colours.tolist()), strict=True))


_CHUNK = 1 << 16
"""Pixels whose spectra are held at once."""

_LONGEST_LABEL = 200


def index_output(asked: str) -> str:
    """The output that the layer `index` shows: an absorption if that is asked for, otherwise an index."""
    # Of the outputs with an argument only these: others read files, which a page must not name.
    return asked if asked.startswith("absorption:") else f"index:{asked}"


def _paint_index(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[_Picture, Legend]:
    """The index or absorption that is chosen, over the background where it is undefined or hardly anything is seen."""
    materials, bands = frame.materials, frame.materials.bands
    if not settings.index:
        centers = bands.centers_nm
        raise ConfigError(
            f"no spectral index is chosen: type a formula of wavelengths that the bands cover, {bands.coverage}, "
            f"such as r{float(centers[-1]):g}/r{float(centers[0]):g}"
        )
    asked = parse_reflectance_map(index_output(settings.index), bands, materials.is_lit)
    index, rows = asked.fit(torch.empty(0, len(bands))), frame.coefficients.flatten()
    # Chunk by chunk: the spectra of a whole picture may not fit into memory.
    chunks = [rows.map(lambda _, part=part: part) for part in rows.packed.split(_CHUNK)]
    values = torch.cat([index(materials.reflectance(chunk)) for chunk in chunks]).view_as(frame.opacity)
    scale = settings.value_range or asked.usual_range
    if scale is None:
        seen = index(materials.reflectance(aids.reference))
        scale = usual_range(seen)
    label = asked.what if len(asked.what) <= _LONGEST_LABEL else f"{asked.what[:_LONGEST_LABEL]}..."
    label += "" if materials.is_light_known else "; of radiance: light unknown"
    if bool((frame.opacity > OCCUPIED_ACCUMULATION).any()) and not bool(values.isfinite().any()):
        label += (
            "; undefined wherever something is: the light has no power at its wavelengths, or it divides by 0"
        )
    return _paint_scaled(values, frame.opacity * values.isfinite(), settings, scale, label)


def _paint_colour(diffuse: bool, specular: bool) -> _Painter:
    def paint(frame: MaterialView, settings: LayerSettings, _: LayerAids) -> tuple[_Picture, Legend]:
        bands = frame.materials.bands
        light = frame.materials.through(
            frame.coefficients, rgb_matrix(bands), diffuse=diffuse, specular=specular
        )
        return _tone_mapped(light, frame.coverage, settings), describe_colour(bands)

    return paint


def _paint_false_colour(
    frame: MaterialView, settings: LayerSettings, _: LayerAids
) -> tuple[_Picture, Legend]:
    bands = frame.materials.bands
    wavelengths = tuple(covered(bands, value) for value in settings.false_colour_nm)
    light = frame.materials.through(frame.coefficients, band_composite_matrix(bands, wavelengths))
    shown = [f"{bands.centers_nm[bands.nearest(value)]:.0f} nm" for value in wavelengths]
    legend = f"red {shown[0]}, green {shown[1]}, blue {shown[2]}"
    return _tone_mapped(light, frame.coverage, settings), legend


def _paint_band(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[_Picture, Legend]:
    materials, bands = frame.materials, frame.materials.bands
    band = bands.nearest(covered(bands, settings.wavelength_nm))
    column = torch.eye(len(bands))[:, band : band + 1]
    reference = _unpremultiplied(materials.through(aids.reference, column), aids.reference.accumulation)
    values = _unpremultiplied(materials.through(frame.coefficients, column), frame.coverage)[..., 0]
    scale = usual_range(reference[:, 0], low_at_most=0.0)
    label = f"{materials.quantity} at {bands.centers_nm[band]:.0f} nm"
    return _paint_scaled(values, frame.coverage, settings, scale, label)


def _paint_abundance(frame: MaterialView, settings: LayerSettings, _: LayerAids) -> tuple[_Picture, Legend]:
    names = frame.materials.names
    index = min(max(settings.endmember, 0), len(names) - 1)
    values = _unpremultiplied(frame.coefficients.abundances, frame.opacity)[..., index]
    return _paint_scaled(values, frame.opacity, settings, (0.0, 1.0), f"abundance of {names[index]}")


def _paint_abundances(
    frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[_Picture, Legend]:
    colours = aids.colours_of(frame.materials)
    picture = _unpremultiplied(frame.coefficients.abundances, frame.opacity) @ colours
    return _over_background(picture, frame.opacity, settings), _swatches(frame.materials.names, colours)


def _paint_segmentation(
    frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[_Picture, Legend]:
    colours = aids.colours_of(frame.materials)
    return _paint_labels(frame["segmentation"], settings, frame.materials.names, colours)


def _paint_pca(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[_Picture, Legend]:
    colours = aids.pca_of(frame.materials)
    seen = _unpremultiplied(frame.materials.through(frame.coefficients, colours.axes), frame.opacity)
    components = seen - colours.mean @ colours.axes
    stretched = (components - colours.low) / (colours.high - colours.low).clamp(min=1e-9)
    legend = "red, green, blue: first, second, third principal component of the spectra"
    return _over_background(stretched.clamp(0, 1), frame.opacity, settings), legend


def _paint_depth(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[_Picture, Legend]:
    label = "distance along the viewing axis, world units"
    return _paint_scaled(frame.depth, frame.opacity, settings, aids.depth_range(frame), label)


def _paint_error(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[_Picture, Legend]:
    if isinstance(aids.measured, str):
        raise ConfigError(f"no error to show: {aids.measured}")
    values, is_known, view = aids.measured.error(frame)
    label = f"mean absolute error of the bands against training view {view}, where it sees the same"
    return _paint_scaled(values, is_known.to(values), settings, (0.0, 0.1), label)


def _unpremultiplied(
    values: Float[Tensor, "*pixels C"], part: Float[Tensor, "*pixels"]
) -> Float[Tensor, "*pixels C"]:
    """Values of what is seen in a part of each pixel, rather than of what is seen on black."""
    return values / part.clamp(min=1e-3)[..., None]


def _own(name: str, paint: _Painter, *controls: str) -> _Layer:
    """A layer with a painter of its own; the rest is that of the output, or the family of outputs, of its name."""
    output = OUTPUTS[name] if name in OUTPUTS else FAMILIES[name]
    return _Layer(name, output.title, paint, frozenset(controls), output.kind == "labels")


LAYERS: dict[str, _Layer] = {
    layer.name: layer
    for layer in (
        _own("rgb", _paint_colour(True, True), "tone"),
        _own("false-colour", _paint_false_colour, "tone", "false-colour"),
        _own("band", _paint_band, "scale", "wavelength"),
        _own("index", _paint_index, "scale", "index"),
        _Layer("abundance", "abundance of one endmember", _paint_abundance, _SCALE | {"endmember"}),
        _own("abundances", _paint_abundances),
        _own("segmentation", _paint_segmentation),
        _layer_of(OUTPUTS["confidence"]),
        _own("diffuse", _paint_colour(True, False), "tone"),
        _own("specular", _paint_colour(False, True), "tone"),
        _own("pca", _paint_pca),
        _own("depth", _paint_depth, "scale"),
        _layer_of(OUTPUTS["accumulation"]),
        _Layer("error", "error against a training view", _paint_error, _SCALE),
    )
}
"""All that can be shown of mixed materials, in the order in which it is offered."""


def layers_of(scene: RenderableScene) -> dict[str, _Layer]:
    """All that can be shown of a scene, by name: what its materials allow, and its outputs that can be painted."""
    if scene.materials is None:
        return {output.name: _layer_of(output) for output in scene.outputs if output.kind in _PAINTED_KINDS}
    others = (output for output in scene.outputs if output.kind in ("map", "vectors"))
    return {**LAYERS, **{output.name: _layer_of(output) for output in others if output.name not in LAYERS}}
