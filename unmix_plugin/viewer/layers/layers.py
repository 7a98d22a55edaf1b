"""What can be shown of a rendered view: functions to a picture and its legend, and what they need of the run.

Titles, kinds and ranges are those of the table of outputs; here is how they are painted.

Notation: pictures are (H, W, 3) sRGB in [0, 1]; what is transparent shows the background. `N` reference rays that end
on something, `B` bands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.registry import Output, OutputKind
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    band_composite_matrix,
    describe_colour,
    rgb_matrix,
    srgb_to_linear,
)
from unmix_plugin.spectral.maps.indices import parse_index
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients, Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.outputs import FAMILIES, OUTPUTS, MaterialView
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.layers.painting import (
    ColourMapLegend,
    LayerSettings,
    Legend,
    Picture,
    SwatchLegend,
    TextLegend,
    colour_table,
    over_background,
    paint_values,
    tone_mapped,
)

_NUM_CAMERAS = 6
_NUM_RAYS = 6000


@torch.no_grad()
def render_reference(scene: TrainedScene, cameras: Cameras) -> tuple[Coefficients, Float[Tensor, "N 3"]]:
    """Coefficients of rays through some of the cameras, spread over all, and where the rays end, model space."""
    step = max(1, len(cameras) // _NUM_CAMERAS)
    chosen = list(range(0, len(cameras), step))[:_NUM_CAMERAS]
    cameras = cameras.one_size()
    aspect = cameras.width / cameras.height
    height = max(1, min(cameras.height, int((_NUM_RAYS / len(chosen) / aspect) ** 0.5)))
    parts, points = [], []
    for index in chosen:
        camera = cameras[index].resized(max(1, round(aspect * height)), height)
        seen = scene.look(camera, subpixels=1).coefficients.flatten()
        rays = camera.to(scene.device).image_rays(0)
        ends = rays.origins + seen.ray_distance[:, None] * rays.directions
        is_seen = seen.is_occupied
        parts.append(seen.map(lambda packed, chosen=is_seen: packed[chosen]))
        points.append(ends[is_seen])
    return Coefficients.concatenate(parts), torch.cat(points)


def _percentile_range(values: Float[Tensor, "N"], low_at_most: float = math.inf) -> tuple[float, float]:
    """From the 1st percentile, or `low_at_most` if that is less, to the 99th; never empty."""
    if len(values) == 0:
        return (0.0, 1.0)
    low, high = torch.quantile(values.float(), values.new_tensor([0.01, 0.99]).float()).tolist()
    low = min(low, low_at_most)
    return (low, high if high > low + 1e-6 else low + 1.0)


_MOST_REMEMBERED = 32
_ValueT = TypeVar("_ValueT")

_ErrorOf = Callable[[MaterialView], tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"], str]]
"""A view's error against the nearest training view, where it is known, and that view's name."""


@dataclass(frozen=True)
class LayerAids:
    """What layers need to know of the run."""

    reference: Coefficients
    """Of some rays through the whole scene that stay the same while the camera moves: colour scales and principal axes
    are taken from them, so that colours mean the same from everywhere. (N, ...)."""
    reference_points: Float[Tensor, "N 3"]
    """Where the rays end, model space."""
    scene_box: SceneBox
    error_of: _ErrorOf | None = None
    why_no_error: str = "the scene is not at hand"
    _kept: dict[tuple[str, bytes], Any] = field(default_factory=dict, repr=False, compare=False)

    def reference_spectra(self, materials: Materials) -> Float[Tensor, "N B"]:
        """What the rays show with the given materials, as if each ended fully on what it ended on."""
        return materials.spectra(self.reference) / self.reference.accumulation[:, None]

    def colours_of(self, materials: Materials) -> Float[Tensor, "K 3"]:
        """sRGB colours that stand for the materials, as in all pictures of a run."""
        return self._remembered(
            "colours",
            materials,
            lambda: torch.as_tensor(endmember_colours(materials)).to(materials.endmembers),
        )

    def _pca_of(self, materials: Materials) -> PcaColours:
        """Principal components of what the reference rays show with the materials."""
        return self._remembered("pca", materials, lambda: PcaColours.fit(self.reference_spectra(materials)))

    def _depth_range(self, frame: MaterialView) -> tuple[float, float]:
        """Distances between which the scene box lies, world units."""
        aabb, scale = self.scene_box.aabb.cpu(), frame.scene.frame.scale
        middle, radius = aabb.mean(dim=0), float((aabb[1] - aabb[0]).norm()) / 2
        distance = float((frame.camera.camera_to_world[0, :, 3].cpu() - middle).norm())
        return (max(0.0, distance - radius) / scale, (distance + radius) / scale)

    def _remembered(self, what: str, materials: Materials, make: Callable[[], _ValueT]) -> _ValueT:
        """What `make` gives, kept for the materials that clients look at."""
        spectra = torch.cat([materials.endmembers, materials.specular_spectra])
        key = (what, spectra.cpu().numpy().tobytes())
        found = self._kept.get(key)  # looked up once: another thread may clear what is kept at any moment
        if found is None:
            if len(self._kept) >= _MOST_REMEMBERED:
                self._kept.clear()
            found = self._kept[key] = make()
        return found


_Painter = Callable[[Any, LayerSettings, Any], tuple[Picture, Legend]]
"""From a rendered view, of the kind of scene that has the layer, and what layers need of the run."""


@dataclass(frozen=True)
class Layer:
    """A name, what users read, and the function that paints it."""

    name: str
    """As in outputs of renders, where there is such an output."""
    title: str
    """What users read."""
    paint: _Painter
    controls: frozenset[str]
    """Which of `wavelength`, `false-colour`, `endmember`, `index`, `tone`, `scale` apply."""
    is_labels: bool = False
    """Whether each colour stands for something of its own, so that pictures must not be compressed with loss."""


def layer_named(name: str, layers: Mapping[str, Layer]) -> Layer:
    """A layer by its name.

    Raises:
        ConfigError: there is none.
    """
    if name not in layers:
        raise ConfigError(f"there is no layer named {name[:40]!r}; known: {', '.join(layers)}")
    return layers[name]


_PAINTED_KINDS: dict[OutputKind, frozenset[str]] = {
    "srgb": frozenset({"tone"}),
    "linear": frozenset({"tone"}),
    "picture": frozenset(),
    "grey": frozenset({"scale"}),
    "map": frozenset({"scale"}),
    "labels": frozenset(),
    "shares": frozenset(),
    "vectors": frozenset(),
}
"""Kinds of outputs that can be painted without knowing more of them, and the controls of their layers."""


def _layer_of(output: Output) -> Layer:
    """The layer of an output of a kind that can be painted."""

    def paint(frame: RenderedView, settings: LayerSettings, _: LayerAids | None) -> tuple[Picture, Legend]:
        values, opacity, legend = frame[output.name], frame.opacity, TextLegend(output.what)
        if output.kind in ("srgb", "linear"):
            light = values if output.kind == "linear" else srgb_to_linear(values.clamp(0, 1))
            return tone_mapped(light, frame.coverage, settings), legend
        if output.kind in ("grey", "map"):
            is_known = values.isfinite()
            scale = output.value_range or _percentile_range(
                values[is_known & (opacity > OCCUPIED_ACCUMULATION)]
            )
            # Opacity itself is shown everywhere, also where there is little of it.
            part = is_known.to(opacity) if output.name == "accumulation" else opacity * is_known
            return _paint_scaled(values, part, settings, scale, output.what)
        # Neighbours of the palette are far apart.
        palette = colour_table("turbo")[torch.arange(256) * 389 % 1024].to(opacity)
        if output.kind == "labels":
            opacity, values = (values != NOTHING_ID).to(opacity), palette[values.long()]
        elif output.kind == "shares":
            palette = palette[: values.shape[-1]]
            values = values / values.sum(dim=-1, keepdim=True).clamp(min=1e-6) @ palette
            names = [f"{output.title} {number}" for number in range(len(palette))]
            legend = _swatches(names, palette)
        elif output.kind == "vectors":
            values = (values + 1) / 2
            legend = TextLegend(f"{output.what}; red, green, blue: x, y, z from -1 to 1")
        return over_background(values.clamp(0, 1), opacity, settings), legend

    return Layer(output.name, output.title, paint, _PAINTED_KINDS[output.kind], output.kind == "labels")


def _paint_scaled(
    values: Float[Tensor, "H W"],
    part: Float[Tensor, "H W"],
    settings: LayerSettings,
    scale: tuple[float, float],
    label: str,
) -> tuple[Picture, Legend]:
    """Values in the colours of a scale, or of the user's own, over the background where they fill but a part."""
    shown = settings.value_range or scale
    picture = paint_values(values, shown, settings.colour_map)
    return over_background(picture, part, settings), ColourMapLegend(settings.colour_map, *shown, label)


def _swatches(names: Sequence[str], colours: Float[Tensor, "K 3"]) -> SwatchLegend:
    return SwatchLegend(tuple(zip(names, map(tuple, colours.tolist()), strict=True)))


_CHUNK = 1 << 16
"""Pixels whose spectra are held at once."""

_LONGEST_LABEL = 120


def _paint_index(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    """The index that is chosen, over the background where it is undefined or hardly anything is seen."""
    materials, bands = frame.materials, frame.materials.bands
    if not settings.index:
        edges, centers = bands.edges_nm, bands.centers_nm
        raise ConfigError(
            f"no spectral index is chosen: type a formula of the wavelengths from {edges[0]:g} to {edges[-1]:g} nm "
            f"that the bands cover, such as r{float(centers[-1]):g}/r{float(centers[0]):g}"
        )
    index, rows = parse_index(settings.index, bands), frame.coefficients.flatten()
    # Chunk by chunk: the spectra of a whole picture may not fit into memory.
    chunks = [rows.map(lambda _, part=part: part) for part in rows.packed.split(_CHUNK)]
    values = torch.cat([index(materials.reflectance(chunk)) for chunk in chunks]).unflatten(
        0, frame.opacity.shape
    )
    scale = settings.value_range or index.usual_range
    if scale is None:
        seen = index(materials.reflectance(aids.reference))
        scale = _percentile_range(seen[seen.isfinite()])
    what = index.what if len(index.what) <= _LONGEST_LABEL else f"{index.what[:_LONGEST_LABEL]}..."
    label = what if materials.light is not None else f"{what}; of radiance: light unknown"
    return _paint_scaled(values, frame.opacity * values.isfinite(), settings, scale, label)


def _paint_colour(diffuse: bool, specular: bool) -> _Painter:
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
    materials, bands = frame.materials, frame.materials.bands
    band = bands.nearest(covered(bands, settings.wavelength_nm))
    column = torch.eye(len(bands))[:, band : band + 1]
    reference = materials.through(aids.reference, column)[:, 0] / aids.reference.accumulation.clamp(min=1e-3)
    values = _unpremultiplied(materials.through(frame.coefficients, column), frame.coverage)[..., 0]
    scale, label = (
        _percentile_range(reference, low_at_most=0.0),
        f"radiance at {bands.centers_nm[band]:.0f} nm",
    )
    return _paint_scaled(values, frame.coverage, settings, scale, label)


def _paint_abundance(frame: MaterialView, settings: LayerSettings, _: LayerAids) -> tuple[Picture, Legend]:
    names = frame.materials.names
    index = min(max(settings.endmember, 0), len(names) - 1)
    values = _unpremultiplied(frame.coefficients.abundances, frame.opacity)[..., index]
    return _paint_scaled(values, frame.opacity, settings, (0.0, 1.0), f"abundance of {names[index]}")


def _paint_abundances(
    frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[Picture, Legend]:
    colours = aids.colours_of(frame.materials)
    picture = _unpremultiplied(frame.coefficients.abundances, frame.opacity) @ colours
    return over_background(picture, frame.opacity, settings), _swatches(frame.materials.names, colours)


def _paint_segmentation(
    frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[Picture, Legend]:
    ids, colours = frame["segmentation"], aids.colours_of(frame.materials)
    palette = torch.cat([colours, colours.new_zeros(256 - len(colours), 3)])
    picture = over_background(palette[ids.long()], (ids != NOTHING_ID).to(colours.dtype), settings)
    return picture, _swatches(frame.materials.names, colours)


def _paint_pca(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    colours = aids._pca_of(frame.materials)
    seen = _unpremultiplied(frame.materials.through(frame.coefficients, colours.axes), frame.opacity)
    components = seen - colours.mean @ colours.axes
    stretched = (components - colours.low) / (colours.high - colours.low).clamp(min=1e-9)
    legend = TextLegend("red, green, blue: first, second, third principal component of the spectra")
    return over_background(stretched.clamp(0, 1), frame.opacity, settings), legend


def _paint_depth(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    label = "distance along the viewing axis, world units"
    return _paint_scaled(frame.depth, frame.opacity, settings, aids._depth_range(frame), label)


def _paint_error(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    if aids.error_of is None:
        raise ConfigError(f"no error to show: {aids.why_no_error}")
    values, is_known, view = aids.error_of(frame)
    label = f"mean absolute error of the bands against training view {view}, where it sees the same"
    return _paint_scaled(values, is_known.to(values), settings, (0.0, 0.1), label)


def _unpremultiplied(values: Float[Tensor, "H W C"], part: Float[Tensor, "H W"]) -> Float[Tensor, "H W C"]:
    """Values of what is seen in a part of each pixel, rather than of what is seen on black."""
    return values / part.clamp(min=1e-3)[..., None]


def covered(bands: Bands, wavelength_nm: float) -> float:
    """The wavelength, or the nearest that some band covers."""
    low, high = float(bands.edges_nm[0]), float(bands.edges_nm[-1])
    return min(max(low, wavelength_nm), high)


def _own(name: str, paint: _Painter, *controls: str) -> Layer:
    """A layer with a painter of its own; the rest is that of the output, or the family of outputs, of its name."""
    output = OUTPUTS[name] if name in OUTPUTS else FAMILIES[name]
    return Layer(name, output.title, paint, frozenset(controls), output.kind == "labels")


LAYERS: dict[str, Layer] = {
    layer.name: layer
    for layer in (
        _own("rgb", _paint_colour(True, True), "tone"),
        _own("false-colour", _paint_false_colour, "tone", "false-colour"),
        _own("band", _paint_band, "scale", "wavelength"),
        _own("index", _paint_index, "scale", "index"),
        Layer("abundance", "abundance of one endmember", _paint_abundance, frozenset({"scale", "endmember"})),
        _own("abundances", _paint_abundances),
        _own("segmentation", _paint_segmentation),
        _layer_of(OUTPUTS["confidence"]),
        _own("diffuse", _paint_colour(True, False), "tone"),
        _own("specular", _paint_colour(False, True), "tone"),
        _own("pca", _paint_pca),
        _own("depth", _paint_depth, "scale"),
        _layer_of(OUTPUTS["accumulation"]),
        Layer("error", "error against a training view", _paint_error, frozenset({"scale"})),
    )
}
"""All that can be shown of mixed materials, in the order in which it is offered."""


def layers_of(scene: RenderableScene) -> dict[str, Layer]:
    """All that can be shown of a scene, by name: what its materials allow, and its outputs that can be painted."""
    if not isinstance(scene, TrainedScene):
        return {output.name: _layer_of(output) for output in scene.outputs if output.kind in _PAINTED_KINDS}
    others = (output for output in scene.outputs if output.kind in ("map", "vectors"))
    return {**LAYERS, **{output.name: _layer_of(output) for output in others if output.name not in LAYERS}}
