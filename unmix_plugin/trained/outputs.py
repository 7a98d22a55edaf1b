"""The table of everything that can be shown of a scene of mixed materials, and what pictures of it are painted from.

Notation: `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.outputs import WORLD_UNITS, Output, OutputKind, no_output
from unmix_plugin.errors import ConfigError, SpectrumError, did_you_mean
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import (
    band_composite_matrix,
    colour_mode,
    describe_colour,
    linear_to_srgb,
    rgb_matrix,
)
from unmix_plugin.spectral.features import FEWEST_BANDS, continuum_removed, derivative_matrix
from unmix_plugin.spectral.intervals import COVERAGE
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Coefficients, Materials, find_endmember
from unmix_plugin.spectral.segmentation import NOTHING_ID, material_scores
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.intervals import SeenPlaces, no_interval, reflectance_number
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.trained.reflectance_maps import ReflectanceMap, Score, parse_reflectance_map
from unmix_plugin.trained.run_materials import endmember_colours


class MixtureView(ABC):
    """What outputs of mixed materials are computed from: a view of one camera, (H, W, ...)."""

    coefficients: Coefficients

    @property
    @abstractmethod
    def materials(self) -> Materials:
        """The spectra that the coefficients are multiplied with."""

    @property
    @abstractmethod
    def opacity(self) -> Tensor:
        """[0, 1]."""

    @property
    @abstractmethod
    def coverage(self) -> Tensor:
        """How much of a pixel shows something, [0, 1]."""

    @property
    @abstractmethod
    def spectra(self) -> Tensor:
        """Radiance on black."""

    @property
    @abstractmethod
    def ray_distance(self) -> Tensor:
        """Along the ray, world units; 0 where nothing is."""

    @property
    @abstractmethod
    def depth(self) -> Tensor:
        """Along the viewing axis, world units; 0 where nothing is."""

    @property
    @abstractmethod
    def normals(self) -> Tensor:
        """Unit vectors in world axes; 0 where nothing is."""

    @property
    @abstractmethod
    def unexplained(self) -> Tensor:
        """Part of what was measured that no mixture of the materials gives, [0, 1]; NaN where that is unknown."""

    @property
    @abstractmethod
    def has_removed(self) -> bool:
        """Whether the scene is shown without some of its materials."""

    @property
    @abstractmethod
    def seen_places(self) -> SeenPlaces:
        """What is seen in each pixel, and how far it is expected to be off; a ConfigError where that is unknown."""

    @abstractmethod
    def map(self, function: Callable[[Tensor], Tensor]) -> MixtureView:
        """The same view with its coefficients on another device, or of some rows."""


Capability: TypeAlias = Literal["light", "training views"]
"""What a scene may lack that an output needs: a known light, a comparison with what its training views measured."""


_Compute: TypeAlias = Callable[[MixtureView], Tensor]
"""From a rendered view to (H, W, ...)."""

_LEAST_SEEN = 1e-3
"""Opacity under which nothing can be said of what is seen."""


@dataclass(frozen=True)
class MaterialOutput(Output):
    """An output of a scene of mixed materials, with its function."""

    compute: Callable[[MixtureView], Tensor] = field(kw_only=True)
    """From a rendered view to (H, W, ...)."""
    needs: frozenset[Capability] = field(default=frozenset(), kw_only=True)
    fewest_bands: int = field(default=1, kw_only=True)
    """With light, that it takes."""
    light: Callable[[MixtureView], Tensor] | None = field(default=None, kw_only=True)
    """Of outputs that are cut at white: the linear light before that, which pictures are painted from."""
    score: ReflectanceMap | None = field(default=None, kw_only=True)
    """Of outputs that are made of reflectance."""

    def judged_against(self, background: Float[Tensor, "N B"]) -> MaterialOutput:
        """The same where what is seen is judged against reflectances of all views, rather than of the view itself."""
        if self.score is None:
            return self
        score = self.score.fit(background)
        return replace(self, compute=lambda view: _scored(view, score))

    def with_components(self, colours: PcaColours) -> MaterialOutput:
        """The output `pca` with the components of all views, rather than of the view itself."""
        return replace(self, compute=lambda view: _components(view, colours))


@dataclass(frozen=True)
class PictureValues:
    """What a picture of an output is painted from."""

    output: Output
    values: Tensor
    """(H, W, ...)."""
    opacity: Float[Tensor, "H W"]
    """How much of each pixel they fill, [0, 1]: light also comes from a sky."""

    @property
    def seen(self) -> Tensor:
        """The numbers of what is seen, where something is."""
        is_there, values = self.opacity > OCCUPIED_ACCUMULATION, self.values
        if self.output.is_premultiplied or self.output.kind == "grey":
            parts = self.opacity.clamp(min=_LEAST_SEEN)
            values = values / parts.view(*parts.shape, *(1,) * (values.dim() - parts.dim()))
        return values[is_there]


@torch.no_grad()
def values_of(view: RenderedView, output: Output) -> Tensor:
    """The numbers of an output of a view, (H, W, ...)."""
    if isinstance(output, MaterialOutput) and isinstance(view, MixtureView):
        return output.compute(view)
    return view[output.name]


_TRACE_OPACITY = 0.25
"""Opacity under which a pixel counts as empty once materials are removed: these leave faint specks where they were
mixed with others."""


@torch.no_grad()
def picture_values(view: RenderedView, output: Output) -> PictureValues:
    """What a picture of an output is painted from: its numbers, or the light before it is cut at white."""
    if not isinstance(output, MaterialOutput) or not isinstance(view, MixtureView):
        return _filled(view, output, view[output.name])
    mixture: MixtureView = view
    if mixture.has_removed:
        is_there = (mixture.opacity >= _TRACE_OPACITY)[..., None]
        mixture = mixture.map(lambda packed: packed * is_there)
    if output.light is not None:
        return _filled(mixture, replace(output, kind="linear"), output.light(mixture))
    return _filled(mixture, output, output.compute(mixture))


def _filled(view: RenderedView | MixtureView, output: Output, values: Tensor) -> PictureValues:
    if output.name == "accumulation":  # opacity itself is shown everywhere, also where there is little of it
        return PictureValues(output, values, torch.ones_like(view.opacity))
    is_light = output.kind in ("srgb", "linear", "grey", "channels")
    return PictureValues(output, values, view.coverage if is_light else view.opacity)


def _light(matrix: Callable[[Bands], Tensor], *, diffuse: bool = True, specular: bool = True) -> _Compute:
    """Linear light through three weights a band, not cut at white: in another light a band may exceed full scale."""
    return lambda view: view.materials.through(
        view.coefficients, matrix(view.materials.bands), diffuse=diffuse, specular=specular
    )


def _components(view: MixtureView, colours: PcaColours) -> Tensor:
    """Principal components of what is seen, stretched to [0, 1]; 0 where nothing is."""
    opacity = view.opacity[..., None]
    seen = view.materials.through(view.coefficients, colours.axes) / opacity.clamp(min=_LEAST_SEEN)
    components = seen - colours.mean @ colours.axes
    stretched = (components - colours.low) / (colours.high - colours.low).clamp(min=1e-9)
    return stretched.clamp(0, 1) * (opacity >= _LEAST_SEEN)


def components_of(materials: Materials, seen: Coefficients) -> PcaColours:
    """Principal components of the spectra of rays that end on something, as if each ended fully on it."""
    return PcaColours.fit(materials.spectra(seen) / seen.accumulation[..., None])


def _pca(view: MixtureView) -> Tensor:
    seen = view.coefficients.flatten()
    return _components(view, components_of(view.materials, seen.map(lambda packed: packed[seen.is_occupied])))


def _reflectance(view: MixtureView) -> Tensor:
    return view.materials.reflectance(view.coefficients)


def _of_lit_bands(function: Callable[[Tensor, np.ndarray], Tensor]) -> Callable[[MixtureView], Tensor]:
    """A function of reflectances and their wavelengths, over the bands with light; NaN in the others."""

    def compute(view: MixtureView) -> Tensor:
        reflectance, lit = _reflectance(view), view.materials.is_lit.cpu()
        found = torch.full_like(reflectance, torch.nan)
        centers_nm = view.materials.bands.centers_nm[lit.numpy()]
        found[..., lit] = function(reflectance[..., lit], centers_nm).to(found)
        return found

    return compute


def _derivative(order: Literal[1, 2]) -> Callable[[MixtureView], Tensor]:
    def derivative(reflectance: Tensor, wavelengths_nm: np.ndarray) -> Tensor:
        matrix = torch.from_numpy(derivative_matrix(wavelengths_nm, order))
        return reflectance.double() @ matrix.to(reflectance.device)

    return _of_lit_bands(derivative)


def _scores(view: MixtureView) -> Tensor:
    return material_scores(view.spectra, view.materials.endmembers)


_UNIT = (0.0, 1.0)
_FULL_SCALE = ("1 = full scale",)
_NOTHING_IS_0 = ("0 where nothing is",)
_NOTHING_IS_NAN = "NaN where nothing is"


def _table() -> tuple[MaterialOutput, ...]:
    """All outputs that take no argument, in the order in which they are offered; `{quantity}` is what spectra are."""
    row = MaterialOutput
    colour, diffuse, specular = (
        _light(rgb_matrix),
        _light(rgb_matrix, specular=False),
        _light(rgb_matrix, diffuse=False),
    )
    needs_light: frozenset[Capability] = frozenset({"light"})
    return (
        row(
            "rgb",
            "srgb",
            "colour",
            "sRGB",
            is_on_black=True,
            remarks=("0 to 1",),
            light=colour,
            compute=lambda view: linear_to_srgb(colour(view).clamp(0, 1)),
        ),
        row(
            "linear_rgb",
            "linear",
            "linear colour",
            "linear light in sRGB primaries",
            is_on_black=True,
            remarks=("0 to 1",),
            light=colour,
            compute=lambda view: colour(view).clamp(0, 1),
        ),
        row(
            "spectral",
            "channels",
            "spectra",
            "{quantity}",
            is_on_black=True,
            remarks=_FULL_SCALE,
            compute=lambda view: view.spectra,
        ),
        row(
            "diffuse",
            "channels",
            "diffuse part",
            "{quantity} without the view-dependent part",
            remarks=_FULL_SCALE,
            compute=lambda view: view.materials.diffuse(view.coefficients),
        ),
        row(
            "diffuse_rgb",
            "srgb",
            "diffuse part in colour",
            "sRGB without the view-dependent part",
            is_on_black=True,
            remarks=("0 to 1",),
            light=diffuse,
            compute=lambda view: linear_to_srgb(diffuse(view).clamp(0, 1)),
        ),
        row(
            "specular",
            "channels",
            "specular part",
            "view-dependent part of the {quantity}",
            remarks=_FULL_SCALE,
            compute=lambda view: view.materials.specular(view.coefficients),
        ),
        row(
            "specular_rgb",
            "srgb",
            "specular part in colour",
            "sRGB of the view-dependent part",
            is_on_black=True,
            remarks=("0 to 1",),
            light=specular,
            compute=lambda view: linear_to_srgb(specular(view).clamp(0, 1)),
        ),
        row(
            "reflectance",
            "spectra",
            "reflectance",
            "radiance over the scene's light",
            needs=needs_light,
            remarks=("1 = as bright as white, shading included", _NOTHING_IS_NAN),
            compute=_reflectance,
        ),
        row(
            "continuum",
            "spectra",
            "continuum removed",
            "reflectance over its continuum, the upper convex hull",
            remarks=("at most 1", _NOTHING_IS_NAN),
            compute=_of_lit_bands(continuum_removed),
        ),
        row(
            "derivative",
            "spectra",
            "derivative",
            "derivative of the reflectance by wavelength",
            unit="1/nm",
            fewest_bands=FEWEST_BANDS,
            remarks=(_NOTHING_IS_NAN,),
            compute=_derivative(1),
        ),
        row(
            "second_derivative",
            "spectra",
            "second derivative",
            "second derivative of the reflectance by wavelength",
            unit="1/nm^2",
            fewest_bands=FEWEST_BANDS,
            remarks=(_NOTHING_IS_NAN,),
            compute=_derivative(2),
        ),
        row(
            "abundances",
            "shares",
            "all abundances",
            "abundances",
            _UNIT,
            is_premultiplied=True,
            remarks=("summing to the opacity",),
            compute=lambda view: view.coefficients.abundances,
        ),
        row(
            "segmentation",
            "labels",
            "segmentation",
            "index of the material",
            nothing=NOTHING_ID,
            remarks=(f"{NOTHING_ID} where nothing is",),
            compute=lambda view: view.materials.ids(view.coefficients),
        ),
        row(
            "confidence",
            "map",
            "segmentation confidence",
            "estimated probability that the material is right",
            _UNIT,
            compute=lambda view: view.materials.confidence(view.coefficients),
        ),
        row(
            "material_scores",
            "shares",
            "similarity to each endmember",
            "cosine of the spectrum to each endmember",
            _UNIT,
            compute=_scores,
        ),
        row(
            "probe_probabilities",
            "shares",
            "probabilities of the probe",
            "softmax over the endmembers of the cosine of the spectrum to each",
            _UNIT,
            remarks=("as published",),
            compute=lambda view: torch.softmax(_scores(view), dim=-1),
        ),
        row(
            "unexplained",
            "map",
            "what no material explains",
            "part of the measured spectrum that no mixture of the materials gives",
            colour_map="magma",
            needs=frozenset({"training views"}),
            remarks=(_NOTHING_IS_NAN,),
            compute=lambda view: view.unexplained,
        ),
        row(
            "pca",
            "picture",
            "principal components",
            "three principal components of the spectra",
            legend="red, green, blue: first, second, third principal component of the spectra",
            remarks=("each stretched from its 1st to its 99th percentile",),
            compute=_pca,
        ),
        row(
            "depth",
            "map",
            "depth",
            "distance along the viewing axis",
            unit=WORLD_UNITS,
            nothing=0,
            remarks=_NOTHING_IS_0,
            compute=lambda view: view.depth,
        ),
        row(
            "ray_distance",
            "map",
            "distance along the ray",
            "distance along the ray",
            unit=WORLD_UNITS,
            nothing=0,
            remarks=_NOTHING_IS_0,
            compute=lambda view: view.ray_distance,
        ),
        row(
            "accumulation",
            "map",
            "opacity",
            "opacity",
            _UNIT,
            "gray",
            remarks=("0 to 1",),
            compute=lambda view: view.opacity,
        ),
        row(
            "normals",
            "vectors",
            "normals",
            "unit normals in world axes",
            remarks=_NOTHING_IS_0,
            compute=lambda view: view.normals,
        ),
    )


OUTPUTS = {one.name: one for one in _table()}
"""By name."""


@dataclass(frozen=True)
class _Family:
    """Outputs of one kind that differ by an argument after a colon."""

    kind: OutputKind
    title: str
    asks: str
    """What the argument is."""
    example: str
    make: Callable[[str, str, Materials], MaterialOutput]
    """From name, argument and materials to the output; raises a ConfigError where the argument can't be read, and a
    SpectrumError where the bands don't cover it."""


def _shown_nm(bands: Bands, wavelengths_nm: Sequence[float]) -> tuple[tuple[float, ...], str]:
    """Centres of the bands that are nearest to the wavelengths asked for, and both in words where they differ."""
    centers = tuple(float(bands.centers_nm[bands.nearest(asked)]) for asked in wavelengths_nm)
    shown, asked = (", ".join(f"{nm:g}" for nm in values) for values in (centers, wavelengths_nm))
    return centers, f"{shown} nm" + (f" (asked: {asked} nm)" if shown != asked else "")


def _band(name: str, argument: str, materials: Materials) -> MaterialOutput:
    wavelength = _wavelength_nm(argument, name)
    centers, shown = _shown_nm(materials.bands, [wavelength])
    band = materials.bands.nearest(wavelength)
    column = torch.eye(len(materials.bands))[:, band : band + 1]
    return MaterialOutput(
        name,
        "grey",
        FAMILIES["band"].title,
        f"{materials.quantity} of one band",
        quantity=materials.quantity,
        centers_nm=centers,
        is_on_black=True,
        remarks=(f"1 = full scale: {shown}",),
        compute=lambda view: view.materials.through(view.coefficients, column)[..., 0],
    )


def _false_colour(name: str, argument: str, materials: Materials) -> MaterialOutput:
    wavelengths = [_wavelength_nm(part, name) for part in argument.split(",")]
    if len(wavelengths) != 3:
        raise ConfigError(
            f"false-colour takes three wavelengths, as in {FAMILIES['false-colour'].example}; got {name}"
        )
    light = _light(lambda bands: band_composite_matrix(bands, wavelengths))
    band_composite_matrix(materials.bands, wavelengths)  # which refuses wavelengths without a band
    centers, shown = _shown_nm(materials.bands, wavelengths)
    return MaterialOutput(
        name,
        "linear",
        FAMILIES["false-colour"].title,
        f"three bands as red, green and blue, {materials.quantity}",
        quantity=materials.quantity,
        centers_nm=centers,
        is_on_black=True,
        legend="red {:.0f} nm, green {:.0f} nm, blue {:.0f} nm".format(*centers),
        remarks=(f"the bands: {shown}",),
        light=light,
        compute=lambda view: light(view).clamp(0, 1),
    )


def _reflectance_map(name: str, _: str, materials: Materials) -> MaterialOutput:
    if materials.sensor is not None and name.startswith("library:"):
        raise ConfigError(
            f"{name} compares with spectra known in the run's own bands and can't be seen through the sensor "
            f"{materials.sensor}; leave out --sensor"
        )
    asked = parse_reflectance_map(name, materials.bands, materials.is_lit)
    undefined = ("NaN where undefined",) if asked.kind == "map" else ()

    def compute(view: MixtureView) -> Tensor:
        if asked.is_local:
            return _scored(view, asked.fit(torch.empty(0, len(view.materials.bands))))
        reflectance = view.materials.reflectance(view.coefficients)
        return asked.fit(reflectance[view.coefficients.is_occupied])(reflectance)

    return MaterialOutput(
        name,
        asked.kind,
        FAMILIES[name.partition(":")[0]].title,
        asked.label,
        asked.usual_range,
        classes=asked.classes,
        nothing=NOTHING_ID if asked.kind == "labels" else None,
        remarks=(*asked.remarks, *_caveat(materials), *undefined),
        score=asked,
        compute=compute,
    )


_CHUNK = 1 << 16
"""Pixels whose spectra are held at once."""


def _scored(view: MixtureView, score: Score) -> Tensor:
    """Numbers made of reflectance, chunk by chunk: the spectra of a whole picture may not fit into memory."""
    rows = view.coefficients.flatten()
    chunks = [rows.map(lambda _, part=part: part) for part in rows.packed.split(_CHUNK)]
    return torch.cat([score(view.materials.reflectance(chunk)) for chunk in chunks]).view(view.opacity.shape)


def _endmember(name: str, materials: Materials) -> int:
    """Number of the endmember that an output such as `abundance:leaf` names."""
    argument = name.partition(":")[2]
    index = find_endmember(argument, materials.names)
    if index is None:
        hint = did_you_mean(argument, materials.names, likeness=0.5, form=" ({})")
        raise ConfigError(
            f"{name}: there is no endmember {argument!r}{hint}; known are {', '.join(materials.names)}"
        )
    return index


def _abundance(name: str, _: str, materials: Materials) -> MaterialOutput:
    index = _endmember(name, materials)
    return MaterialOutput(
        name,
        "map",
        FAMILIES["abundance"].title,
        f"abundance of {materials.names[index]}",
        _UNIT,
        is_premultiplied=True,
        compute=lambda view: view.coefficients.abundances[..., index],
    )


Ends: TypeAlias = Callable[[SeenPlaces, float], tuple[Tensor, Tensor]]
"""From what is seen at places, and a coverage, to the low and high ends of intervals."""


def interval_ends(name: str, materials: Materials) -> Ends:
    """Intervals of an output by its name; errors are those of `find_output`, and a ConfigError where it has none."""
    if name == "abundances":
        return SeenPlaces.of_abundances
    if name == "spectral":
        return SeenPlaces.of_spectra
    output, prefix = find_output(name, materials), name.partition(":")[0]
    if prefix == "abundance":
        index = _endmember(name, materials)

        def of_one(seen: SeenPlaces, coverage: float) -> tuple[Tensor, Tensor]:
            low, high = seen.of_abundances(coverage)
            return low[..., index], high[..., index]

        return of_one
    if prefix == "band":
        band = materials.bands.nearest(_wavelength_nm(name.partition(":")[2], name))

        def of_band(seen: SeenPlaces, coverage: float) -> tuple[Tensor, Tensor]:
            low, high = seen.of_spectra(coverage)
            return low[..., band], high[..., band]

        return of_band
    if name == "reflectance":
        number = reflectance_number(materials)
    elif output.score is not None and output.score.is_local and output.kind == "map":
        number = reflectance_number(materials, output.score.fit(torch.empty(0, len(materials.bands))))
    else:
        raise no_interval(name)
    return lambda seen, coverage: seen.of_number(number, coverage)


def _interval(name: str, argument: str, materials: Materials) -> MaterialOutput:
    """Width of the interval of an output of one number a pixel; of `abundance`, that of the largest one."""
    about = f"width of the {COVERAGE:.0%} interval"
    if argument == "abundance":
        what = "largest abundance"

        def width(view: MixtureView) -> Tensor:
            low, high = view.seen_places.of_abundances()
            largest = view.coefficients.abundances.argmax(dim=-1, keepdim=True)
            return (high - low).gather(-1, largest)[..., 0]

    else:
        one = find_output(argument, materials)
        if one.kind not in ("map", "grey"):
            raise no_interval(argument)
        ends, what = interval_ends(argument, materials), one.label

        def width(view: MixtureView) -> Tensor:
            low, high = ends(view.seen_places, COVERAGE)
            return high - low

    is_abundance = argument.partition(":")[0] == "abundance"
    return MaterialOutput(
        name,
        "map",
        FAMILIES["interval"].title,
        f"{about}, {what}",
        (0.0, 0.5) if is_abundance else None,
        remarks=("NaN where not determined",),
        compute=width,
    )


def _caveat(materials: Materials) -> tuple[str, ...]:
    """What is to be said of outputs that are made of reflectance."""
    return () if materials.is_light_known else ("of radiance, since the scene's light is unknown",)


def _wavelength_nm(text: str, name: str) -> float:
    try:
        return float(text.strip().removesuffix("nm"))
    except ValueError:
        raise ConfigError(f"{text!r} in the output {name} is not a wavelength in nm, such as 650nm") from None


FAMILIES: dict[str, _Family] = {
    "band": _Family("grey", "one band", "a wavelength", "band:650nm", _band),
    "false-colour": _Family(
        "linear", "false colour", "wavelengths", "false-colour:860,650,550", _false_colour
    ),
    "abundance": _Family(
        "map", "abundance of one endmember", "a name or a number from 0", "abundance:0", _abundance
    ),
    "index": _Family("map", "spectral index", "to know which", "index:ndvi", _reflectance_map),
    "target": _Family("map", "likeness to a target", "to know which", "target:paint.csv", _reflectance_map),
    "library": _Family("labels", "nearest of a library", "a file", "library:mine.csv<0.1", _reflectance_map),
    "absorption": _Family("map", "absorption", "wavelengths", "absorption:650-700", _reflectance_map),
    "interval": _Family("map", "width of the interval", "an output", "interval:abundance", _interval),
}
"""By the part of the name before the colon."""


def find_output(name: str, materials: Materials) -> MaterialOutput:
    """An output by its name, such as `rgb`, `band:650nm` or `index:ndvi`.

    Raises:
        ConfigError: there is none, or its argument can't be read.
        SpectrumError: the bands don't cover what it needs.
    """
    if name in OUTPUTS:
        return _fitted(OUTPUTS[name], materials)
    prefix, _, argument = name.partition(":")
    family = FAMILIES.get(prefix)
    if family is None:
        examples = [family.example for family in FAMILIES.values()]
        raise no_output(name, [*OUTPUTS, *FAMILIES], [*OUTPUTS, *examples])
    if not argument:
        raise ConfigError(f"the output {prefix} needs {family.asks}, as in {family.example}")
    return family.make(name, argument, materials)


def usual_range(values: Float[Tensor, "*values"], low_at_most: float = math.inf) -> tuple[float, float]:
    """From the 1st percentile of what is known, or `low_at_most` if that is less, to the 99th; never empty."""
    known = values[values.isfinite()].float()
    if len(known) == 0:
        return 0.0, 1.0
    low, high = torch.quantile(known, known.new_tensor([0.01, 0.99])).tolist()
    low = min(low, low_at_most)
    return low, high if high - low > 1e-6 * max(abs(low), abs(high)) else low + max(1.0, abs(low))


def available_outputs(materials: Materials) -> tuple[MaterialOutput, ...]:
    """All outputs that take no argument, but those that `find_output` refuses."""
    found = []
    for output in OUTPUTS.values():
        with suppress(SpectrumError):
            found.append(_fitted(output, materials))
    return tuple(found)


def _fitted(output: MaterialOutput, materials: Materials) -> MaterialOutput:
    """An output that takes no argument, for these materials: with the quantity that their spectra are, reflectance
    where a white is 1 in every band, else radiance, and remarks where colours are false or the light is unknown.

    Raises:
        SpectrumError: it needs a light that is unknown, or more bands with light.
    """
    if "light" in output.needs and not materials.is_light_known:
        raise SpectrumError(
            "the scene's light is unknown, so that it has no reflectance: process it with a white reference (--white), "
            "or name the light as illuminant_path in transforms.json"
        )
    lit_nm = materials.bands.centers_nm[materials.is_lit.cpu().numpy()]
    if len(lit_nm) < output.fewest_bands:
        derivative_matrix(lit_nm)  # which refuses fewer
    more: tuple[str, ...] = ()
    legend, classes = output.legend, output.classes
    if output.kind in ("srgb", "linear"):
        legend = describe_colour(materials.bands)
    if output.kind in ("labels", "shares"):
        colours = map(tuple, endmember_colours(materials).tolist())
        classes = tuple(zip(materials.names, colours, strict=True))
    if output.kind in ("srgb", "linear") and colour_mode(materials.bands) == "false-colour":
        more = (describe_colour(materials.bands),)
    elif output.kind == "spectra":
        more = _caveat(materials)
    quantity = materials.quantity if output.kind == "channels" else None
    label = output.label.replace("{quantity}", materials.quantity)
    remarks = (*output.remarks, *more)
    return replace(output, label=label, quantity=quantity, remarks=remarks, legend=legend, classes=classes)
