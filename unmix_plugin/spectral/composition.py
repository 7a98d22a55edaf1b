"""From composited coefficients to everything a picture can show: spectra, bands, colour, segmentation.

The diffuse spectrum of a ray is linear in the endmembers, sum_i w_i E^T S_i a_i = E^T sum_i w_i S_i a_i, so a renderer
composites K + J numbers a ray and the B bands are made here, once a ray; so is every other picture of the same view.

Notation: `B` bands, `K` endmembers, `J` spectra of the specular dictionary, `*rays` any leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import band_composite_matrix, linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.maps.reflectance_maps import (
    is_reflectance_map,
    parse_reflectance_map,
    seen_reflectance,
)
from unmix_plugin.spectral.pca import PcaColours
from unmix_plugin.spectral.segmentation import material_ids, material_scores


@dataclass(frozen=True)
class Coefficients:
    """What is composited along rays; all are weighted sums over the samples of a ray."""

    accumulation: Float[Tensor, "*rays"]
    """Opacity, [0, 1]."""
    distance: Float[Tensor, "*rays"]
    """Sum of weight times distance from the camera along the ray, scene units."""
    abundances: Float[Tensor, "*rays K"]
    """a, summing to the accumulation."""
    scaled_abundances: Float[Tensor, "*rays K"]
    """S a: what the endmembers are multiplied with."""
    specular: Float[Tensor, "*rays J"]
    """h u: what the specular dictionary is multiplied with; J = 0 without a view-dependent part."""

    def unflatten(self, height: int, width: int) -> Coefficients:
        """Rows of rays as an image."""
        return Coefficients(*(getattr(self, name).unflatten(0, (height, width)) for name in _FIELDS))

    @staticmethod
    def mean(passes: list[Coefficients]) -> Coefficients:
        """Mean over several renders of the same rays: since all outputs but ratios are linear, that of a pixel."""
        return Coefficients(
            *(sum(getattr(one, name) for one in passes) / len(passes) for name in _FIELDS)  # type: ignore[arg-type]
        )

    @staticmethod
    def concatenate(parts: list[Coefficients]) -> Coefficients:
        """The rays of all parts, in order."""
        return Coefficients(*(torch.cat([getattr(part, name) for part in parts]) for name in _FIELDS))


SegmentationMethod = Literal["abundances", "probe"]


def default_names(count: int) -> tuple[str, ...]:
    """What endmembers are called that nobody has named.

    >>> default_names(2)
    ('endmember_0', 'endmember_1')
    """
    return tuple(f"endmember_{index}" for index in range(count))


_FIELDS = ("accumulation", "distance", "abundances", "scaled_abundances", "specular")


@dataclass(frozen=True)
class Materials:
    """The spectra that coefficients are multiplied with."""

    bands: Bands
    endmembers: Float[Tensor, "K B"]
    specular_spectra: Float[Tensor, "J B"]
    segmentation: SegmentationMethod = "abundances"
    """How a ray's material is chosen: its largest abundance, or the paper's probe, the endmember of smallest angle
    to the ray's spectrum."""
    names: tuple[str, ...] = ()
    """One for each endmember, distinct: what it is called in every file and figure. None given: `default_names`."""
    light: Float[Tensor, "B"] | None = None
    """Relative power of the light that the spectra are seen in; None where it is unknown."""
    lead_error: Float[Tensor, ""] | None = None
    """Standard error of the lead of the largest abundance over the second; None where nothing says it."""

    def __post_init__(self) -> None:
        """Give names where there are none.

        Raises:
            SpectrumError: another number of names than of endmembers, or two the same.
        """
        count = len(self.endmembers)
        if not self.names:
            object.__setattr__(self, "names", default_names(count))
        if len(set(self.names)) != count or len(self.names) != count:
            raise SpectrumError(f"{count} endmembers need {count} distinct names; found {list(self.names)}")

    def diffuse(self, coefficients: Coefficients) -> Float[Tensor, "*rays B"]:
        """Spectra without the view-dependent part."""
        return coefficients.scaled_abundances @ self.endmembers

    def specular(self, coefficients: Coefficients) -> Float[Tensor, "*rays B"]:
        """Spectra of the view-dependent part; zero without one."""
        return coefficients.specular @ self.specular_spectra


SPECTRUM_OUTPUTS = ("spectral", "diffuse", "specular")
COLOUR_OUTPUTS = ("rgb", "linear_rgb", "pca")
MATERIAL_OUTPUTS = ("abundances", "material_scores", "segmentation", "confidence")
GEOMETRY_OUTPUTS = ("accumulation", "depth", "ray_distance")
PARAMETRIC_OUTPUTS = (
    "band:<nm>",
    "false-colour:<red nm>,<green nm>,<blue nm>",
    "index:<name or formula>",
    "target:<file.csv>",
)
OUTPUT_NAMES = (*SPECTRUM_OUTPUTS, *COLOUR_OUTPUTS, *MATERIAL_OUTPUTS, *GEOMETRY_OUTPUTS)

OCCUPIED_ACCUMULATION = 0.5
"""A ray belongs to a material only where at least this much of it ends on something."""


def compose(name: str, coefficients: Coefficients, materials: Materials) -> Tensor:
    """One output of a render by its name.

    Args:
        name: One of `OUTPUT_NAMES` but `depth`, which needs a camera, or `band:650nm`, `false-colour:860,650,550`,
            `index:ndvi`, `target:ace:paint.csv`.
        coefficients: What was composited along the rays.
        materials: The spectra to use.
    Returns:
        `spectral`, `diffuse`, `specular` (*rays, B); `rgb` sRGB and `linear_rgb` (*rays, 3) in [0, 1];
        `pca` (*rays, 3) in [0, 1]; `abundances`, `material_scores` (*rays, K); `segmentation` (*rays) uint8, 255 where
        nothing is; `confidence` (*rays) in [0, 1]: estimated probability that the largest share is so in truth, 0 where
        nothing is; `accumulation`, `ray_distance` (*rays) in scene units, 0 where nothing is; `band:` (*rays);
        `false-colour:` (*rays, 3) in [0, 1], not gamma-encoded; `index:`, `target:` (*rays), NaN where nothing is.
    Raises:
        ConfigError: an unknown name, or an argument that can't be read.
        SpectrumError: a wavelength outside the bands.
    """
    kind, _, argument = name.partition(":")
    if kind == "band" and argument:
        return spectral(coefficients, materials)[..., materials.bands.nearest(_parse_nm(argument, name))]
    if kind == "false-colour" and argument:
        wavelengths = [_parse_nm(part, name) for part in argument.split(",")]
        if len(wavelengths) != 3:
            raise ConfigError(
                f"false-colour takes three wavelengths, as in false-colour:860,650,550; got {name}"
            )
        matrix = band_composite_matrix(materials.bands, (wavelengths[0], wavelengths[1], wavelengths[2]))
        return (spectral(coefficients, materials) @ matrix.to(coefficients.abundances)).clamp(0, 1)
    if is_reflectance_map(name) and argument:
        return _reflectance_map(name, coefficients, materials)
    if name not in _COMPOSERS:
        known = ", ".join((*OUTPUT_NAMES, *PARAMETRIC_OUTPUTS))
        raise ConfigError(f"there is no output named {name}; known: {known}")
    return _COMPOSERS[name](coefficients, materials)


def spectral(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays B"]:
    """Spectra seen along the rays, on black."""
    return materials.diffuse(coefficients) + materials.specular(coefficients)


def reflectance(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays B"]:
    """Reflectance of what is seen, in the sense of `seen_reflectance`."""
    return reflectance_of(spectral(coefficients, materials), coefficients.accumulation, materials)


def reflectance_of(
    spectra: Float[Tensor, "*rays B"], opacity: Float[Tensor, "*rays"], materials: Materials
) -> Float[Tensor, "*rays B"]:
    """The same of spectra that are composed already, on any device."""
    return seen_reflectance(spectra, opacity, materials.light, OCCUPIED_ACCUMULATION)


def _reflectance_map(name: str, coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays"]:
    """An index, or a target's score against the other pixels of the same view."""
    asked, seen = parse_reflectance_map(name, materials.bands), reflectance(coefficients, materials)
    return asked.fit(seen[coefficients.accumulation >= OCCUPIED_ACCUMULATION])(seen)


def _linear_rgb(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays 3"]:
    matrix = rgb_matrix(materials.bands).to(coefficients.abundances)
    # Not clamped at 1 before the colours are: in another light a band may exceed the sensor's full scale.
    return (spectral(coefficients, materials).clamp(min=0) @ matrix).clamp(0, 1)


def _rgb(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays 3"]:
    return linear_to_srgb(_linear_rgb(coefficients, materials))


def _material_scores(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays K"]:
    return material_scores(spectral(coefficients, materials), materials.endmembers)


def _segmentation(coefficients: Coefficients, materials: Materials) -> Tensor:
    scores = (
        coefficients.abundances
        if materials.segmentation == "abundances"
        else _material_scores(coefficients, materials)
    )
    return material_ids(scores, coefficients.accumulation, OCCUPIED_ACCUMULATION)


def _confidence(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays"]:
    """How probably the largest abundance is so in truth, its lead having a normal error; the lead if none is known."""
    if coefficients.abundances.shape[-1] == 1:
        return coefficients.accumulation
    largest = coefficients.abundances.topk(2, dim=-1).values
    lead = (largest[..., 0] - largest[..., 1]) / coefficients.accumulation.clamp(min=OCCUPIED_ACCUMULATION)
    if materials.lead_error is not None:
        lead = torch.special.ndtr(lead / materials.lead_error.clamp(min=1e-3))
    return lead * (coefficients.accumulation > OCCUPIED_ACCUMULATION)


def _ray_distance(coefficients: Coefficients, _: Materials) -> Float[Tensor, "*rays"]:
    return coefficients.distance / coefficients.accumulation.clamp(min=1e-6)


def _pca(coefficients: Coefficients, materials: Materials) -> Float[Tensor, "*rays 3"]:
    """First three principal components of the image's spectra, each stretched between its 1st and 99th percentile."""
    spectra = spectral(coefficients, materials)
    seen = coefficients.accumulation > OCCUPIED_ACCUMULATION
    return PcaColours.fit(spectra[seen])(spectra) * seen[..., None]


_COMPOSERS = {
    "spectral": spectral,
    "diffuse": lambda coefficients, materials: materials.diffuse(coefficients),
    "specular": lambda coefficients, materials: materials.specular(coefficients),
    "rgb": _rgb,
    "linear_rgb": _linear_rgb,
    "pca": _pca,
    "abundances": lambda coefficients, _: coefficients.abundances,
    "material_scores": _material_scores,
    "segmentation": _segmentation,
    "confidence": _confidence,
    "accumulation": lambda coefficients, _: coefficients.accumulation,
    "ray_distance": _ray_distance,
}


def _parse_nm(text: str, name: str) -> float:
    try:
        return float(text.strip().removesuffix("nm"))
    except ValueError:
        raise ConfigError(f"{text!r} in the output {name} is not a wavelength in nm, such as 650nm") from None
