"""Every output of a scene of mixed materials: its name, what its numbers are, and how it is computed.

Notation: `H x W` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from unmix_plugin.engine.registry import Output, no_output
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import material_scores
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.trained.outputs.families import FAMILIES


@dataclass(frozen=True)
class MaterialOutput(Output):
    """An output with its function."""

    compute: Callable[[MaterialView], Tensor] = field(kw_only=True)
    """From a rendered view to (H, W, ...)."""


def _linear_rgb(view: MaterialView) -> Tensor:
    # Clamped after the colours are made: in another light a band may exceed the sensor's full scale.
    return view.materials.through(view.coefficients, rgb_matrix(view.materials.bands)).clamp(0, 1)


def _pca(view: MaterialView) -> Tensor:
    spectra, seen = view.spectra, view.coefficients.is_occupied
    return PcaColours.fit(spectra[seen])(spectra) * seen[..., None]


def _material_scores(view: MaterialView) -> Tensor:
    return material_scores(view.spectra, view.materials.endmembers)


_UNIT = (0.0, 1.0)


_DESCRIBED = (
    Output("rgb", "srgb", "colour", "sRGB on black, 0 to 1"),
    Output("linear_rgb", "linear", "linear colour", "linear light in sRGB primaries on black, 0 to 1"),
    Output("spectral", "channels", "spectra", "radiance on black, 1 = full scale"),
    Output("diffuse", "channels", "diffuse part", "radiance without the view-dependent part, 1 = full scale"),
    Output("specular", "channels", "specular part", "view-dependent part of the radiance, 1 = full scale"),
    Output("abundances", "shares", "all abundances", "abundances, summing to the opacity", _UNIT),
    Output("segmentation", "labels", "segmentation", "index of the material, 255 where nothing is"),
    Output(
        "confidence",
        "map",
        "segmentation confidence",
        "estimated probability that the material is right",
        _UNIT,
    ),
    Output(
        "material_scores",
        "shares",
        "similarity to each endmember",
        "cosine of the spectrum to each endmember",
        _UNIT,
    ),
    Output(
        "probe_probabilities",
        "shares",
        "probabilities of the probe",
        "softmax over the endmembers of the cosine of the spectrum to each, as published",
        _UNIT,
    ),
    Output(
        "pca",
        "picture",
        "principal components",
        "three principal components of the spectra, each stretched from its 1st to its 99th percentile",
    ),
    Output("depth", "map", "depth", "distance along the viewing axis in world units, 0 where nothing is"),
    Output(
        "ray_distance",
        "map",
        "distance along the ray",
        "distance along the ray in world units, 0 where nothing is",
    ),
    Output("accumulation", "map", "opacity", "opacity, 0 to 1", _UNIT, "gray"),
    Output("normals", "vectors", "normals", "unit normals in world axes, 0 where nothing is"),
)

_COMPUTED: dict[str, Callable[[MaterialView], Tensor]] = {
    "rgb": lambda view: linear_to_srgb(_linear_rgb(view)),
    "linear_rgb": _linear_rgb,
    "spectral": lambda view: view.spectra,
    "diffuse": lambda view: view.materials.diffuse(view.coefficients),
    "specular": lambda view: view.materials.specular(view.coefficients),
    "abundances": lambda view: view.coefficients.abundances,
    "segmentation": lambda view: view.materials.ids(view.coefficients),
    "confidence": lambda view: view.materials.confidence(view.coefficients),
    "material_scores": _material_scores,
    "probe_probabilities": lambda view: torch.softmax(_material_scores(view), dim=-1),
    "pca": _pca,
    "depth": lambda view: view.depth,
    "ray_distance": lambda view: view.ray_distance,
    "accumulation": lambda view: view.opacity,
    "normals": lambda view: view.normals,
}

OUTPUTS = {
    output.name: MaterialOutput(**vars(output), compute=_COMPUTED[output.name]) for output in _DESCRIBED
}
"""All outputs that take no argument, in the order in which they are offered."""


def output_names() -> tuple[str, ...]:
    """Every name, with an example of each output that takes an argument."""
    return (*OUTPUTS, *(family.example for family in FAMILIES.values()))


def find_output(name: str, materials: Materials) -> MaterialOutput:
    """An output by its name, such as `rgb`, `band:650nm` or `index:ndvi`.

    Raises:
        ConfigError: there is none, or its argument can't be read.
        SpectrumError: the bands don't cover what it needs.
    """
    if name in OUTPUTS:
        return OUTPUTS[name]
    prefix, _, argument = name.partition(":")
    family = FAMILIES.get(prefix)
    if family is None:
        raise no_output(name, [*OUTPUTS, *FAMILIES], output_names())
    if not argument:
        raise ConfigError(f"the output {prefix} needs {family.needs}, as in {family.example}")
    made = family.make(name, argument, materials)
    return MaterialOutput(name, family.kind, family.title, made.what, made.value_range, compute=made.compute)
