"""First guess of a scene's endmembers from the pixels of all its training views.

Notation: `N` pixels pooled over views, `B` bands, `K` endmembers; spectra in [0, 1], bands last.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.kmeans_normalised import normalised_kmeans, scale_to_lit_pixels
from unmix_plugin.spectral.unmixing.minimum_volume import minimum_volume_simplex
from unmix_plugin.spectral.unmixing.nfindr_winter1999 import nfindr
from unmix_plugin.spectral.unmixing.pooled_pairs import pooled_pair_endmembers
from unmix_plugin.spectral.unmixing.two_material_mixtures import two_material_endmembers
from unmix_plugin.spectral.unmixing.vca_nascimento2005 import vca

EndmemberMethod = Literal["kmeans", "vca", "nfindr", "minimum-volume", "pairs", "pooled-pairs"]

_VCA_DRAWS = 5
"""Of which that of the largest simplex stays. The other methods restart by themselves, as often."""

DARK_RMS = 0.005
"""Root mean square over bands below which a pixel counts as black: its direction is noise."""

_DARK_SHARE = 0.03
"""Pixels darker than this share of the bright ones (99th percentile) say little about material either."""


def initialise_endmembers(
    pixels: Float[Tensor, "N B"],
    num_endmembers: int,
    method: EndmemberMethod,
    generator: torch.Generator,
    max_pixels: int = 20_000,
) -> Float[Tensor, "K B"]:
    """Endmember spectra in [0, 1], as bright as the well-lit pixels that look like them.

    Args:
        pixels: Spectra of all training views, background left out where it is known.
        method: `kmeans` takes the mean shapes of clusters, which serves scenes whose materials each cover some area;
            `vca` and `nfindr` take extreme pixels, which serves mixtures of which pure pixels exist;
            `minimum-volume` takes the corners of the smallest simplex around nearly all pixels, which serves mixtures
            without pure pixels; `pairs` takes the mean shapes that explain the pixels best as mixtures of two, which
            serves surfaces whose materials meet.
        generator: On the CPU; the only source of randomness.
        max_pixels: More are thinned out at random to this number.
    Raises:
        SpectrumError: NaN or infinite values, more endmembers than bands or than distinct pixels neither dark nor
            saturated, pixels that span too few dimensions, or more than 64 endmembers for `pairs`.
    """
    usable = _usable_pixels(pixels, num_endmembers, generator, max_pixels)
    if method == "kmeans" or num_endmembers == 1:
        return normalised_kmeans(usable, num_endmembers, generator).endmembers.clamp(0, 1)
    spectra = _shapes(usable, num_endmembers, method, generator)
    return scale_to_lit_pixels(spectra, usable, _most_similar(usable, spectra)).clamp(0, 1)


def drop_uninformative_pixels(pixels: Float[Tensor, "N B"]) -> Float[Tensor, "kept B"]:
    """Pixels that show a spectral shape: neither dark nor saturated.

    Dark: root mean square at most 0.005 or at most 3 % of that of the bright ones. Saturated: some band at 1 or above,
    where the sensor clips; a lamp in view would otherwise become a material.
    """
    unsaturated = pixels[pixels.amax(dim=1) < 1]
    if len(unsaturated) == 0:
        return unsaturated
    rms = unsaturated.square().mean(dim=1).sqrt()
    bright = float(rms.kthvalue(max(1, round(0.99 * len(rms)))).values)
    return unsaturated[rms > max(DARK_RMS, _DARK_SHARE * bright)]


def has_spectral_shape(pixels: Float[Tensor, "N B"]) -> Bool[Tensor, " N"]:
    """Where a pixel is neither black (root mean square over bands at most 0.005) nor saturated (1 or above)."""
    return (pixels.amax(dim=1) < 1) & (pixels.square().mean(dim=1).sqrt() > DARK_RMS)


def _shapes(
    usable: Float[Tensor, "N B"],
    num_endmembers: int,
    method: Literal["vca", "nfindr", "minimum-volume", "pairs", "pooled-pairs"],
    generator: torch.Generator,
) -> Float[Tensor, "K B"]:
    """Endmembers of any brightness."""
    if method == "vca":
        draws = [vca(usable, num_endmembers, generator).endmembers.clamp(min=0) for _ in range(_VCA_DRAWS)]
        return max(draws, key=_log_volume)
    if method == "minimum-volume":
        return minimum_volume_simplex(usable, num_endmembers, generator)
    if method == "pooled-pairs":
        return pooled_pair_endmembers(usable, num_endmembers, generator)
    if method == "pairs":
        return two_material_endmembers(usable, num_endmembers, generator)
    # On spectra of one brightness: otherwise the darkest pixels are the corners of the largest simplex.
    return usable[nfindr(usable / usable.sum(dim=1, keepdim=True), num_endmembers, generator)]


def _log_volume(spectra: Float[Tensor, "K B"]) -> float:
    """Of their simplex at one brightness, up to a constant."""
    shapes = spectra.double() / spectra.double().sum(dim=1, keepdim=True).clamp(min=1e-12)
    edges = shapes[1:] - shapes[0]
    return float(torch.linalg.slogdet(edges @ edges.T).logabsdet)


def _usable_pixels(
    pixels: Tensor, num_endmembers: int, generator: torch.Generator, max_pixels: int
) -> Tensor:
    num_bands = pixels.shape[1]
    if not 1 <= num_endmembers <= num_bands:
        raise SpectrumError(
            f"the number of endmembers must lie between 1 and the number of bands, {num_bands}; "
            f"found {num_endmembers}"
        )
    finite = torch.isfinite(pixels).all(dim=1)
    if not bool(finite.all()):
        raise SpectrumError(
            f"{int((~finite).sum())} of {len(pixels)} pixels hold NaN or infinite values; mask them out first"
        )
    usable = drop_uninformative_pixels(pixels)
    if len(usable) > max_pixels:
        kept = torch.randperm(len(usable), generator=generator)[:max_pixels]
        usable = usable[kept.to(usable.device)]
    num_distinct = _count_distinct(usable, num_endmembers)
    if num_distinct < num_endmembers:
        advice = f"ask for at most {num_distinct}" if num_distinct else "check the scale of the cubes"
        raise SpectrumError(
            f"{num_endmembers} endmembers were asked for but only {num_distinct} distinct pixels are neither "
            f"dark nor saturated (of {len(pixels)}); {advice}"
        )
    return usable


def _count_distinct(pixels: Tensor, enough: int) -> int:
    """Number of distinct rows; counting stops at `enough`."""
    count = 0
    while count < enough and len(pixels) > 0:
        pixels = pixels[(pixels != pixels[0]).any(dim=1)]
        count += 1
    return count


def _most_similar(pixels: Float[Tensor, "N B"], spectra: Float[Tensor, "K B"]) -> Int[Tensor, " N"]:
    return (pixels @ torch.nn.functional.normalize(spectra, dim=1).T).argmax(dim=1)
