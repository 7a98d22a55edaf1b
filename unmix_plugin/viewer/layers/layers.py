"""What can be shown: pure functions from a rendered view to a picture and its legend.

Titles, kinds and ranges are those of the registry of outputs; here is how materials are painted.

Notation: pictures are (H, W, 3) sRGB in [0, 1]; what is transparent shows the background. `light` is linear RGB seen on
black.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import band_composite_matrix, describe_colour, rgb_matrix
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.outputs.families import FAMILIES
from unmix_plugin.trained.outputs.registry import OUTPUTS
from unmix_plugin.trained.protocol import RenderableScene
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.layers.index_layer import paint_index
from unmix_plugin.viewer.layers.layer import Layer, Painter
from unmix_plugin.viewer.layers.layer_aids import LayerAids
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.output_layers import PAINTED_KINDS, layer_of
from unmix_plugin.viewer.layers.painting import (
    ColourMapLegend,
    Legend,
    Picture,
    SwatchLegend,
    TextLegend,
    over_background,
    paint_values,
    tone_mapped,
)


def _paint_colour(diffuse: bool, specular: bool) -> Painter:
    def paint(frame: MaterialView, settings: LayerSettings, _: LayerAids) -> tuple[Picture, Legend]:
        bands = frame.materials.bands
        light = frame.materials.through(
            frame.coefficients, rgb_matrix(bands), diffuse=diffuse, specular=specular
        )
        # The view-dependent part is light added to what is there: it has no opacity of its own.
        part = frame.coverage if diffuse else torch.ones_like(light[..., 0])
        return tone_mapped(light, part, settings), TextLegend(describe_colour(bands))

    return paint


def _paint_false_colour(frame: MaterialView, settings: LayerSettings, _: LayerAids) -> tuple[Picture, Legend]:
    bands = frame.materials.bands
    wavelengths = tuple(covered(bands, value) for value in settings.false_colour_nm)
    light = frame.materials.through(frame.coefficients, band_composite_matrix(bands, wavelengths))
    shown = [f"{bands.centers_nm[bands.nearest(value)]:.0f} nm" for value in wavelengths]
    legend = TextLegend(f"red {shown[0]}, green {shown[1]}, blue {shown[2]}")
    return tone_mapped(light, frame.coverage, settings), legend


def _paint_band(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    bands = frame.materials.bands
    band = bands.nearest(covered(bands, settings.wavelength_nm))
    column = torch.eye(len(bands))[:, band : band + 1]
    reference = aids.reference.coefficients
    solid = frame.materials.through(reference, column)[:, 0] / reference.accumulation.clamp(min=1e-3)
    scale = aids.reference.range_of(solid)
    label = f"radiance at {bands.centers_nm[band]:.0f} nm"
    values = _unpremultiplied(frame.materials.through(frame.coefficients, column), frame.coverage)[..., 0]
    return _paint_seen(values, frame.coverage, settings, scale, label)


def _paint_abundance(frame: MaterialView, settings: LayerSettings, _: LayerAids) -> tuple[Picture, Legend]:
    index = min(max(settings.endmember, 0), len(frame.materials.names) - 1)
    values = _unpremultiplied(frame.coefficients.abundances, frame.opacity)[..., index]
    label = f"abundance of {frame.materials.names[index]}"
    return _paint_seen(values, frame.opacity, settings, (0.0, 1.0), label)


def _paint_abundances(
    frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[Picture, Legend]:
    colours = aids.colours_of(frame.materials)
    picture = _unpremultiplied(frame.coefficients.abundances, frame.opacity) @ colours
    return over_background(picture, frame.coefficients.accumulation, settings), _swatches(frame, colours)


def _paint_segmentation(
    frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[Picture, Legend]:
    ids = frame["segmentation"]
    colours = aids.colours_of(frame.materials)
    palette = torch.cat([colours, colours.new_zeros(256 - len(colours), 3)])
    is_something = (ids != NOTHING_ID).to(colours.dtype)
    return over_background(palette[ids.long()], is_something, settings), _swatches(frame, colours)


def _paint_pca(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    colours = aids.pca_of(frame.materials)
    components = (
        _unpremultiplied(frame.materials.through(frame.coefficients, colours.axes), frame.opacity)
        - colours.mean @ colours.axes
    )
    stretched = (components - colours.low) / (colours.high - colours.low).clamp(min=1e-9)
    legend = TextLegend("red, green, blue: first, second, third principal component of the spectra")
    return over_background(stretched.clamp(0, 1), frame.coefficients.accumulation, settings), legend


def _paint_depth(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    scale = settings.value_range or aids.depth_range(frame)
    picture = paint_values(frame.depth, scale, settings.colour_map)
    legend = ColourMapLegend(settings.colour_map, *scale, "distance along the viewing axis, world units")
    return over_background(picture, frame.coefficients.accumulation, settings), legend


def _paint_error(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    if aids.error_of is None:
        raise ConfigError(f"no error to show: {aids.why_no_error}")
    values, is_known, view = aids.error_of(frame)
    scale = settings.value_range or (0.0, 0.1)
    picture = paint_values(values, scale, settings.colour_map)
    label = f"mean absolute error of the bands against training view {view}, where it sees the same"
    legend = ColourMapLegend(settings.colour_map, *scale, label)
    return over_background(picture, is_known.to(picture.dtype), settings), legend


def _paint_seen(
    values: Float[Tensor, "H W"],
    part: Float[Tensor, "H W"],
    settings: LayerSettings,
    scale: tuple[float, float],
    label: str,
) -> tuple[Picture, Legend]:
    """Values of what is seen in the colours of a scale, over the background where it fills but a part of a pixel."""
    shown = settings.value_range or scale
    picture = paint_values(values, shown, settings.colour_map)
    legend = ColourMapLegend(settings.colour_map, *shown, label)
    return over_background(picture, part, settings), legend


def _unpremultiplied(values: Float[Tensor, "H W C"], part: Float[Tensor, "H W"]) -> Float[Tensor, "H W C"]:
    """Values of what is seen in a part of each pixel, rather than of what is seen on black."""
    return values / part.clamp(min=1e-3)[..., None]


def _swatches(frame: MaterialView, colours: Float[Tensor, "K 3"]) -> SwatchLegend:
    return SwatchLegend(tuple(zip(frame.materials.names, map(tuple, colours.tolist()), strict=True)))


def covered(bands: Bands, wavelength_nm: float) -> float:
    """The wavelength, or the nearest that some band covers."""
    low, high = float(bands.edges_nm[0]), float(bands.edges_nm[-1])
    return min(max(low, wavelength_nm), high)


def _own(name: str, paint: Painter, *controls: str) -> Layer:
    """A layer with a painter of its own; the rest is that of the output, or the family of outputs, of its name."""
    output = OUTPUTS[name] if name in OUTPUTS else FAMILIES[name]
    return Layer(name, output.title, paint, frozenset(controls), output.kind == "labels")


LAYERS: dict[str, Layer] = {
    layer.name: layer
    for layer in (
        _own("rgb", _paint_colour(True, True), "tone"),
        _own("false-colour", _paint_false_colour, "tone", "false-colour"),
        _own("band", _paint_band, "scale", "wavelength"),
        _own("index", paint_index, "scale", "index"),
        Layer("abundance", "abundance of one endmember", _paint_abundance, frozenset({"scale", "endmember"})),
        _own("abundances", _paint_abundances),
        _own("segmentation", _paint_segmentation),
        layer_of(OUTPUTS["confidence"]),
        _own("diffuse", _paint_colour(True, False), "tone"),
        _own("specular", _paint_colour(False, True), "tone"),
        _own("pca", _paint_pca),
        _own("depth", _paint_depth, "scale"),
        layer_of(OUTPUTS["accumulation"]),
        Layer("error", "error against a training view", _paint_error, frozenset({"scale"})),
    )
}
"""All that can be shown of mixed materials, in the order in which it is offered."""


def layers_of(scene: RenderableScene) -> dict[str, Layer]:
    """All that can be shown of a scene, by name: what its materials allow, and its outputs that can be painted."""
    if not isinstance(scene, TrainedScene):
        return {output.name: layer_of(output) for output in scene.outputs if output.kind in PAINTED_KINDS}
    others = (output for output in scene.outputs if output.kind in ("map", "vectors"))
    return {**LAYERS, **{output.name: layer_of(output) for output in others if output.name not in LAYERS}}
