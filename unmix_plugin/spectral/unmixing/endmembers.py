"""First guess of a scene's endmembers from the pixels of all its training views, from a file, or from partial bands.

Notation: `N` pixels pooled over views, `B` bands, `b` channels of a sensor, `K` endmembers; spectra in [0, 1], bands
last.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.evidence import DARK_RMS
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.spectral.unmixing.abundances import nnls
from unmix_plugin.spectral.unmixing.kmeans_normalised import normalised_kmeans, scale_to_lit_pixels
from unmix_plugin.spectral.unmixing.pooled_search import pooled_search
from unmix_plugin.spectral.unmixing.simplex_corners import minimum_volume_simplex, nfindr, vca
from unmix_plugin.spectral.unmixing.two_material_mixtures import two_material_endmembers

_MOST_PIXELS = 20_000
"""That endmembers are searched in; more are thinned out at random."""
_VCA_DRAWS = 5
"""Of which that of the largest simplex stays. The other methods restart by themselves, as often."""
_DARK_SHARE = 0.03
"""Pixels darker than this share of the bright ones (99th percentile) say little about material either."""
_SMOOTHNESS = 1e-3
"""Weight of differences between neighbouring bands, against that of what was seen."""
_CONTRAST = 0.6
"""Of distinct spectra: how far they are from the typical one, in both directions."""
_LIT_QUANTILE = 0.99
_LIT_SCALE = 0.75
"""Scale that fully lit pixels should need: a sigmoid near 1 hardly learns (vnir-pots, 500 steps: +0.9 dB against 1)."""
_PIXELS_FOR_BRIGHTNESS = 5000
_DARK_MATERIAL = 0.25
"""Length of the darkest endmember, as a share of the brightest, below which brightness does not decide amounts."""


EndmemberMethod = Literal["kmeans", "vca", "nfindr", "minimum-volume", "pairs", "pooled"]


def initialise_endmembers(
    pixels: Float[Tensor, "N B"], num_endmembers: int, method: EndmemberMethod, generator: torch.Generator
) -> Float[Tensor, "K B"]:
    """Endmember spectra in [0, 1], as bright as the well-lit pixels that look like them.

    Args:
        pixels: Spectra of all training views, background left out where it is known.
        method: `kmeans` takes the mean shapes of clusters, which serves scenes whose materials each cover some area;
            `vca` and `nfindr` take extreme pixels, which serves mixtures of which pure pixels exist;
            `minimum-volume` takes the corners of the smallest simplex around nearly all pixels, which serves mixtures
            without pure pixels; `pairs` takes the mean shapes that explain the pixels best as mixtures of two, which
            serves surfaces whose materials meet; `pooled` chooses among the sets that several of these searches find.
        generator: On the CPU; the only source of randomness.
    Raises:
        SpectrumError: NaN or infinite values, more endmembers than bands or than distinct pixels neither dark nor
            saturated, pixels that span too few dimensions, or more than 64 endmembers for `pairs`.
    """
    usable = usable_pixels(pixels, num_endmembers, generator)
    if method == "kmeans" or num_endmembers == 1:
        return normalised_kmeans(usable, num_endmembers, generator)[0].clamp(0, 1)
    if method == "vca":
        draws = [vca(usable, num_endmembers, generator)[0].clamp(min=0) for _ in range(_VCA_DRAWS)]
        found = max(draws, key=_log_volume)
    elif method == "minimum-volume":
        found = minimum_volume_simplex(usable, num_endmembers, generator)
    elif method == "pooled":
        found = pooled_search(usable, num_endmembers, generator).endmembers
    elif method == "pairs":
        found = two_material_endmembers(usable, num_endmembers, generator)
    else:  # on spectra of one brightness, or the darkest pixels would be the corners of the largest simplex
        found = usable[nfindr(usable / usable.sum(dim=1, keepdim=True), num_endmembers, generator)]
    return as_lit_pixels(found, usable)


def as_lit_pixels(spectra: Float[Tensor, "K B"], pixels: Float[Tensor, "N B"]) -> Float[Tensor, "K B"]:
    """The spectra, in [0, 1], as bright as the well-lit pixels that look like them."""
    most_similar = (pixels @ torch.nn.functional.normalize(spectra, dim=1).T).argmax(dim=1)
    return scale_to_lit_pixels(spectra, pixels, most_similar).clamp(0, 1)


def drop_uninformative_pixels(pixels: Float[Tensor, "N B"]) -> Float[Tensor, "kept B"]:
    """Pixels that show a spectral shape: neither dark (root mean square at most 0.005 or 3 % of that of bright ones)
    nor saturated (a band at 1 or above, where the sensor clips: a lamp in view would otherwise become a material)."""
    unsaturated = pixels[pixels.amax(dim=1) < 1]
    if len(unsaturated) == 0:
        return unsaturated
    rms = unsaturated.square().mean(dim=1).sqrt()
    bright = float(rms.kthvalue(max(1, round(0.99 * len(rms)))).values)
    return unsaturated[rms > max(DARK_RMS, _DARK_SHARE * bright)]


def _log_volume(spectra: Float[Tensor, "K B"]) -> float:
    """Of their simplex at one brightness, up to a constant."""
    shapes = spectra.double() / spectra.double().sum(dim=1, keepdim=True).clamp(min=1e-12)
    edges = shapes[1:] - shapes[0]
    return float(torch.linalg.slogdet(edges @ edges.T).logabsdet)


def usable_pixels(
    pixels: Float[Tensor, "N B"], num_endmembers: int, generator: torch.Generator
) -> Float[Tensor, "kept B"]:
    """Pixels that show a spectral shape, thinned out at random where there are more than 20,000; they have to be
    finite, and bands and distinct pixels no fewer than endmembers."""
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
    if len(usable) > _MOST_PIXELS:
        kept = torch.randperm(len(usable), generator=generator)[:_MOST_PIXELS]
        usable = usable[kept.to(usable.device)]
    num_distinct = len(usable.unique(dim=0))
    if num_distinct < num_endmembers:
        advice = f"ask for at most {num_distinct}" if num_distinct else "check the scale of the cubes"
        raise SpectrumError(
            f"{num_endmembers} endmembers were asked for but only {num_distinct} distinct pixels are neither "
            f"dark nor saturated (of {len(pixels)}); {advice}"
        )
    return usable


def fill_bands(
    seen: Float[Tensor, "K b"], matrix: Float[Tensor, "b B"], typical: Float[Tensor, "B"]
) -> Float[Tensor, "K B"]:
    """The spectra that a sensor with this matrix saw as `seen`, their ratio to a typical spectrum of the scene, which
    is positive, as smooth over bands as may be."""
    operator = matrix.double() * typical.double()
    differences = torch.diff(torch.eye(len(typical), dtype=torch.float64), dim=0)
    square = operator.T @ operator
    smooth = _SMOOTHNESS * square.diagonal().mean() * (differences.T @ differences)
    ratios = torch.linalg.lstsq(square + smooth, operator.T @ seen.double().T).solution
    return (ratios.T * typical.double()).clamp(min=0).to(seen)


def typical_spectrum(
    means: list[Float[Tensor, " _"]], matrices: list[Float[Tensor, "_ B"]]
) -> Float[Tensor, "B"]:
    """A smooth positive spectrum that sensors with these matrices see as the means of their pixels."""
    seen, matrix = torch.cat(means)[None], torch.cat(matrices)
    filled = fill_bands(seen, matrix, torch.ones(matrix.shape[1], dtype=seen.dtype))[0]
    return filled.clamp(min=0.01 * float(filled.max().clamp(min=1e-6)))


def distinct_spectra(typical: Float[Tensor, "B"], count: int) -> Float[Tensor, "K B"]:
    """At most as many spectra as bands around a typical one, of other shapes, where no sensor tells the materials."""
    bands = (torch.arange(len(typical)) + 0.5) / len(typical)
    middles = (torch.arange(count)[:, None] + 0.5) / count
    shapes = 1 - _CONTRAST + 2 * _CONTRAST * torch.exp(-0.5 * ((bands - middles) * count) ** 2)
    return (shapes.to(typical) * typical).clamp(0, 1)


def given_endmembers(
    path: Path,
    count: int,
    bands: Bands,
    lamp: Float[Tensor, "B"],
    pixels: Float[Tensor, "N B"],
    generator: torch.Generator,
) -> Float[Tensor, "K B"]:
    """Radiance of the reflectances in a CSV (wavelength,name,...) under the scene's lamp, as bright as the scene.

    A scene's exposure is anything. So all are multiplied by the one factor with which nearly every pixel, of at most
    5000 that the generator chooses, is a mixture of amounts that sum to at most 0.75; ratios between spectra stay.

    Raises:
        ConfigError: another number of spectra than `count`.
        SpectrumError: they don't cover the bands, or explain no pixel.
    """
    table = read_spectra(path).resampled(bands)
    if len(table.names) != count:
        raise ConfigError(
            f"{path} has {len(table.names)} spectra but num-endmembers is {count}; give both the same number"
        )
    radiance = (torch.as_tensor(table.spectra, dtype=torch.float32) * lamp).clamp(min=0)
    usable = drop_uninformative_pixels(pixels)
    usable = usable[torch.randperm(len(usable), generator=generator)[:_PIXELS_FOR_BRIGHTNESS]]
    amounts = nnls(usable.double(), radiance.double()).sum(dim=1)
    factor = float(torch.quantile(amounts, _LIT_QUANTILE)) / _LIT_SCALE if len(amounts) else 0.0
    if not factor > 0:
        raise SpectrumError("the given endmembers explain no pixel of the training views")
    return radiance * factor


def comparable_brightness(endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "K B"]:
    """The endmembers; all with the largest peak of any if one is less than a quarter as long as the longest.

    Amounts are in units of their endmember. In units of one that is nearly black, such as water in the near infrared,
    haze, glint and light from the neighbourhood become large amounts (benchmarks/results/tried.md).
    """
    lengths = endmembers.norm(dim=1)
    return endmembers if bool(lengths.min() >= _DARK_MATERIAL * lengths.max()) else equal_peaks(endmembers)


def equal_peaks(endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "K B"]:
    """The endmembers, all with the largest peak of any."""
    peaks = endmembers.amax(dim=1, keepdim=True)
    return endmembers * (peaks.max() / peaks.clamp(min=1e-12))
