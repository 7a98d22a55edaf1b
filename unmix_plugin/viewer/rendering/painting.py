"""The layers of the viewer: which output each shows, with which controls, and what its colours mean as HTML.

A layer is an output of renders, painted as renders are (`figures/paint.py`): what a page shows, `unmix-render` draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from unmix_plugin.engine.outputs import Output, OutputKind
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.paint import ColourScale, Legend, Painted, colour_table, needs_range, paint
from unmix_plugin.figures.plotting import css_colour
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.trained.mixture_view import PictureValues, picture_values, usual_range
from unmix_plugin.trained.outputs import FAMILIES
from unmix_plugin.trained.plain_outputs import OUTPUTS
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.trained_scene import MaterialView, material_view
from unmix_plugin.viewer.page import BLOCK_STYLE, paragraph, swatches
from unmix_plugin.viewer.rendering.aids import LayerAids
from unmix_plugin.viewer.rendering.settings import LayerSettings, covered

_LONGEST_LABEL = 200


def legend_html(shown: Legend) -> str:
    """What the colours of a picture mean."""
    if isinstance(shown, str):
        return paragraph(shown)
    if not isinstance(shown, ColourScale):
        return swatches(shown)
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


@dataclass(frozen=True)
class Layer:
    """One thing that a page can show."""

    name: str
    title: str
    """What users read."""
    controls: frozenset[str] = frozenset()
    """Which of `wavelength`, `false-colour`, `endmember`, `index`, `tone`, `scale` apply."""
    is_labels: bool = False
    """Whether each colour stands for something of its own, so that pictures must not be compressed with loss."""
    output: Callable[[LayerSettings, Bands], str] | None = None
    """Name of the output that it shows, by what is chosen and the bands shown; None: its own name."""
    row: Output | None = None
    """The output itself, where it is the same whatever is chosen."""

    def output_name(self, settings: LayerSettings, bands: Bands | None) -> str:
        """The output that it shows, by the bands that are shown (None of a scene without spectra).

        Raises:
            ConfigError: nothing is chosen yet.
        """
        return self.name if self.output is None or bands is None else self.output(settings, bands)


def layer_named(name: str, layers: Mapping[str, Layer]) -> Layer:
    """A layer by its name; a ConfigError if there is none."""
    if name not in layers:
        raise ConfigError(f"there is no layer named {name[:40]!r}; known: {', '.join(layers)}")
    return layers[name]


def paint_layer(
    layer: Layer, frame: RenderedView, settings: LayerSettings, aids: LayerAids | None
) -> Painted:
    """A layer of a rendered view; `aids` are there of a scene of materials.

    Colours mean the same from everywhere: where only views tell between which values they go, that is asked of rays
    through the whole scene; of other methods' scenes, which have none, of the view itself.

    Raises:
        ConfigError: it can't be shown, as an error without measurements.
        SpectrumError: the bands don't cover what it needs.
    """
    if (seen := material_view(frame)) is not None and aids is not None:
        output, shown, ends = _of_materials(layer, seen, settings, aids)
    else:
        assert layer.row is not None, layer.name
        output, shown, ends = layer.row, picture_values(frame, layer.row), None
        if needs_range(output, settings):
            ends = usual_range(shown.seen)
    painted = paint(shown.output, shown.values, shown.opacity, ends, settings)
    if not isinstance(legend := painted.legend, ColourScale):
        return painted
    label = output.described("")
    label = label if len(label) <= _LONGEST_LABEL else f"{label[:_LONGEST_LABEL]}..."
    is_seen = shown.opacity > OCCUPIED_ACCUMULATION
    if bool(is_seen.any()) and not bool(shown.values[is_seen].isfinite().any()):
        label += (
            "; undefined wherever something is: the light has no power at its wavelengths, or it divides by 0"
        )
    return replace(painted, legend=replace(legend, label=label))


def _of_materials(
    layer: Layer, frame: MaterialView, settings: LayerSettings, aids: LayerAids
) -> tuple[Output, PictureValues, tuple[float, float] | None]:
    """The output that a layer shows, what its picture is painted from, and the ends of its colours where only the scene
    tells them."""
    if layer.name == "error":
        if isinstance(aids.measured, str):
            raise ConfigError(f"no error to show: {aids.measured}")
        values, is_known, view = aids.measured.error(frame)
        label = f"mean absolute error of the bands against training view {view}, where it sees the same"
        output = Output("error", "map", layer.title, label, (0.0, 0.1))
        return output, PictureValues(output, values, is_known.to(values)), None
    output = frame.scene.output(layer.output_name(settings, frame.materials.bands))
    if output.name == "pca":
        output = output.with_components(aids.components_of(frame.materials))
    shown = picture_values(frame, output)
    if output.name == "depth":
        return output, shown, aids.depth_range(frame)
    if not needs_range(output, settings):
        return output, shown, None
    everywhere = picture_values(aids.reference_view(frame), output)
    return output, shown, usual_range(everywhere.seen, 0.0 if output.kind == "grey" else math.inf)


def index_output(asked: str) -> str:
    """The output that the layer `index` shows: an absorption if that is asked for, otherwise an index."""
    # Of the outputs with an argument only these: others read files, which a page must not name.
    return asked if asked.startswith("absorption:") else f"index:{asked}"


def _index(settings: LayerSettings, bands: Bands) -> str:
    if not settings.index:
        centers = bands.centers_nm
        raise ConfigError(
            f"no spectral index is chosen: type a formula of wavelengths that the bands cover, {bands.coverage}, "
            f"such as r{float(centers[-1]):g}/r{float(centers[0]):g}"
        )
    return index_output(settings.index)


def _center(bands: Bands, wavelength_nm: float) -> str:
    return f"{bands.centers_nm[bands.nearest(covered(bands, wavelength_nm))]:g}"


_TONE, _SCALE = frozenset({"tone"}), frozenset({"scale"})
_CONTROLS: dict[OutputKind, frozenset[str]] = {
    **dict.fromkeys(("srgb", "linear"), _TONE),
    **dict.fromkeys(("grey", "map"), _SCALE),
    **dict.fromkeys(("picture", "labels", "shares", "vectors"), frozenset[str]()),
}
"""Controls of layers by the kind of their output; other kinds are no pictures."""


def _layer(
    name: str, *controls: str, output: Callable[[LayerSettings, Bands], str] | str | None = None
) -> Layer:
    """A layer of mixed materials that shows the output, or the family of outputs, of its name, or another output."""
    shown = output if isinstance(output, str) else name
    row = OUTPUTS[shown] if shown in OUTPUTS else FAMILIES[shown]
    # Of a single band values are painted in colours, as maps are.
    own = _SCALE if name == "band" else _CONTROLS[row.kind]
    chosen = (lambda *_: output) if isinstance(output, str) else output
    return Layer(name, OUTPUTS.get(name, row).title, own | set(controls), row.kind == "labels", chosen)


LAYERS: dict[str, Layer] = {
    layer.name: layer
    for layer in (
        _layer("rgb"),
        _layer(
            "false-colour",
            "false-colour",
            output=lambda chosen, bands: (
                "false-colour:" + ",".join(_center(bands, nm) for nm in chosen.false_colour_nm)
            ),
        ),
        _layer(
            "band",
            "wavelength",
            output=lambda chosen, bands: f"band:{_center(bands, chosen.wavelength_nm)}nm",
        ),
        _layer("index", "index", output=_index),
        _layer("abundance", "endmember", output=lambda chosen, _: f"abundance:{chosen.endmember}"),
        _layer("abundances"),
        _layer("segmentation"),
        _layer("confidence"),
        _layer("diffuse", output="diffuse_rgb"),
        _layer("specular", output="specular_rgb"),
        _layer("pca"),
        _layer("depth"),
        _layer("accumulation"),
        Layer("error", "error against a training view", _SCALE),
    )
}
"""All that can be shown of mixed materials, in the order in which it is offered."""


def layers_of(scene: RenderableScene) -> dict[str, Layer]:
    """All that can be shown of a scene, by name: what its materials allow, and its outputs that can be painted."""
    known = {} if scene.materials is None else LAYERS
    kinds = set(_CONTROLS) if scene.materials is None else {"map", "vectors"}
    others = (output for output in scene.outputs if output.kind in kinds and output.name not in known)
    return {
        **known,
        **{
            one.name: Layer(one.name, one.title, _CONTROLS[one.kind], one.kind == "labels", row=one)
            for one in others
        },
    }
