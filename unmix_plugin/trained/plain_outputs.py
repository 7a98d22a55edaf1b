"""The table of outputs of mixed materials that take no argument, in the order in which they are offered."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from unmix_plugin.engine.outputs import WORLD_UNITS
from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode, describe_colour, linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.features import FEWEST_BANDS, continuum_removed, derivative_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID, material_scores
from unmix_plugin.trained.mixture_view import (
    Capability,
    MaterialOutput,
    MixtureView,
    components_of,
    shown_components,
)
from unmix_plugin.trained.run_materials import endmember_colours

_Compute: TypeAlias = Callable[[MixtureView], Tensor]
"""From a rendered view to (H, W, ...)."""


def light_through(
    matrix: Callable[[Bands], Tensor], *, diffuse: bool = True, specular: bool = True
) -> _Compute:
    """Linear light through three weights per band, not cut at white: in another light a band may exceed full scale."""
    return lambda view: view.materials.through(
        view.coefficients, matrix(view.materials.bands), diffuse=diffuse, specular=specular
    )


def _of_lit_bands(function: Callable[[Tensor, np.ndarray], Tensor]) -> Callable[[MixtureView], Tensor]:
    """A function of reflectances and their wavelengths, over the bands with light; NaN in the others."""

    def compute(view: MixtureView) -> Tensor:
        reflectance = view.materials.reflectance(view.coefficients)
        lit = view.materials.is_lit.cpu()
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
        light_through(rgb_matrix),
        light_through(rgb_matrix, specular=False),
        light_through(rgb_matrix, diffuse=False),
    )

    def pca(view: MixtureView) -> Tensor:
        seen = view.coefficients.flatten()
        occupied = seen.map(lambda packed: packed[seen.is_occupied])
        return shown_components(view, components_of(view.materials, occupied))

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
            compute=lambda view: view.materials.reflectance(view.coefficients),
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
            compute=pca,
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


def available_outputs(materials: Materials) -> tuple[MaterialOutput, ...]:
    """All outputs that take no argument, but those that `find_output` refuses."""
    found = []
    for output in OUTPUTS.values():
        with suppress(SpectrumError):
            found.append(fitted(output, materials))
    return tuple(found)


def fitted(output: MaterialOutput, materials: Materials) -> MaterialOutput:
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
        more = caveat(materials)
    quantity = materials.quantity if output.kind == "channels" else None
    label = output.label.replace("{quantity}", materials.quantity)
    remarks = (*output.remarks, *more)
    return replace(output, label=label, quantity=quantity, remarks=remarks, legend=legend, classes=classes)


def caveat(materials: Materials) -> tuple[str, ...]:
    """What is to be said of outputs that are made of reflectance."""
    return () if materials.is_light_known else ("of radiance, since the scene's light is unknown",)
