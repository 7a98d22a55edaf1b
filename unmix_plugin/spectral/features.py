"""Features of spectra: the continuum and the absorptions below it, derivatives, and components in order of their noise.

The continuum is the upper convex hull of a spectrum over its wavelengths; a spectrum divided by it is 1 where nothing
absorbs, and shows the shape of absorptions whatever the brightness and the slope around them.

Notation: `N` spectra of `B` bands at the wavelengths w, increasing, nm; `H x W` pixels of an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from unmix_plugin.errors import SpectrumError

AbsorptionMeasure = Literal["depth", "centre", "area"]
"""Of the deepest absorption: how far it goes below the continuum, [0, 1]; at which wavelength, nm; and what it takes
away over all wavelengths looked at, nm."""

LEAST_DEPTH = 0.01
"""Absorptions less deep have no centre: noise makes such dips anywhere."""


def continuum(
    spectra: Float[Tensor, "*N B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> Float64[Tensor, "*N B"]:
    """Upper convex hull of each spectrum over its wavelengths; NaN where a spectrum has a value that is not finite.

    Source: Clark and Roush 1984, Journal of Geophysical Research 89(B7); by the gift wrapping of Jarvis 1973, from each
    corner to the band that the hull climbs to most steeply, for all spectra at once.

    >>> continuum(torch.tensor([0.2, 0.2, 0.4]), np.array([400.0, 500.0, 600.0]))
    tensor([0.2000, 0.3000, 0.4000], dtype=torch.float64)
    """
    values = spectra.double().reshape(-1, spectra.shape[-1])
    w = torch.tensor(wavelengths_nm, device=values.device)
    count, last = len(values), len(w) - 1
    index = torch.arange(len(w), device=values.device)
    is_corner = torch.zeros(values.shape, dtype=torch.bool, device=values.device)
    is_corner[:, 0] = is_corner[:, last] = True
    rows = values.isfinite().all(dim=1).nonzero()[:, 0]
    corner = torch.zeros(count, dtype=torch.long, device=values.device)
    while len(rows := rows[corner[rows] < last]):
        at = corner[rows]
        ahead = index > at[:, None]
        run = (w - w[at][:, None]).where(ahead, 1.0)
        slopes = ((values[rows] - values[rows, at][:, None]) / run).masked_fill(~ahead, -torch.inf)
        # Of bands on one line the farthest.
        corner[rows] = last - slopes.flip(1).argmax(dim=1)
        is_corner[rows, corner[rows]] = True
    left = torch.where(is_corner, index, 0).cummax(dim=1).values
    right = torch.where(is_corner, index, last).flip(1).cummin(dim=1).values.flip(1)
    part = (w - w[left]) / (w[right] - w[left]).where(right > left, 1.0)
    low, high = values.gather(1, left), values.gather(1, right)
    hull = torch.where(values.isfinite().all(dim=1, keepdim=True), low + part * (high - low), torch.nan)
    return hull.reshape(spectra.shape)


def continuum_removed(
    spectra: Float[Tensor, "*N B"], wavelengths_nm: Float64[np.ndarray, " B"]
) -> Float64[Tensor, "*N B"]:
    """Spectra over their `continuum`: at most 1, and 1 where nothing absorbs, nor can where the continuum is 0 or less,
    as at an outermost band of 0; NaN for spectra that have no value above 0.
    """
    hull = continuum(spectra, wavelengths_nm)
    beside = torch.where(hull.amax(dim=-1, keepdim=True) > 0, 1.0, torch.nan)
    return torch.where(hull > 0, spectra.double() / hull, beside)


def absorption(
    spectra: Float[Tensor, "*N B"], wavelengths_nm: Float64[np.ndarray, " B"], measure: AbsorptionMeasure
) -> Float64[Tensor, "*N"]:
    """The deepest absorption below the continuum of these bands; NaN where a spectrum has no continuum.

    Depth and centre are those of the parabola through the lowest band of the continuum-removed spectrum and its
    neighbours. Without an absorption depth and area are 0; one below `LEAST_DEPTH` has no centre, NaN.

    Args:
        spectra, wavelengths_nm: Of the bands looked at alone, three or more: what lies outside bears no continuum.
    Source:
        Clark and Roush 1984; the parabola: Rodger et al. 2012, Remote Sensing of Environment 118.
    """
    removed = continuum_removed(spectra, wavelengths_nm)
    w = torch.tensor(wavelengths_nm, device=removed.device)
    if measure == "area":
        return torch.trapezoid(1 - removed, w, dim=-1)
    lowest = removed[..., 1:-1].nan_to_num(1.0).argmin(dim=-1, keepdim=True) + 1
    before, least, after = (removed.gather(-1, lowest + step)[..., 0] for step in (-1, 0, 1))
    middle = w[lowest[..., 0]]
    back, ahead = w[lowest[..., 0] - 1] - middle, w[lowest[..., 0] + 1] - middle
    # Newton's form of the parabola: least + first * t + second * t * (t - back), t = wavelength - middle.
    first = (before - least) / back
    second = ((after - least) / ahead - first) / (ahead - back)
    offset = torch.where(second > 0, (back - first / second.where(second > 0, 1.0)) / 2, 0.0)
    depth = 1 - (least + first * offset + second * offset * (offset - back))
    if measure == "depth":
        return depth
    return torch.where(depth >= LEAST_DEPTH, middle + offset, torch.nan)


FEWEST_BANDS = 5
"""Of a derivative: a parabola is fitted to so many."""


def derivative_matrix(
    wavelengths_nm: Float64[np.ndarray, " B"], order: Literal[1, 2] = 1
) -> Float64[np.ndarray, "B B"]:
    """D such that spectra @ D are their derivatives by wavelength, a nm or a nm squared.

    At each band that of the parabola of least squares through it and its neighbours, five bands in all; at the ends
    through the outermost five. For evenly spaced bands these are the filters of Savitzky and Golay 1964, as
    `scipy.signal.savgol_filter` has them; gaps and uneven steps are allowed for.
    """
    count = len(wavelengths_nm)
    if count < FEWEST_BANDS:
        raise SpectrumError(f"a derivative takes {FEWEST_BANDS} bands or more; found {count}")
    matrix = np.zeros((count, count))
    for band, wavelength in enumerate(wavelengths_nm):
        first = min(max(band - FEWEST_BANDS // 2, 0), count - FEWEST_BANDS)
        near = slice(first, first + FEWEST_BANDS)
        fit = np.linalg.pinv(np.vander(wavelengths_nm[near] - wavelength, 3, increasing=True))
        matrix[near, band] = order * fit[order]
    return matrix


@dataclass(frozen=True)
class NoiseFractions:
    """An image's components, those of most signal first: each has a noise of 1 and is independent of the others."""

    components: Float64[Tensor, "H W C"]
    """0 where the mask is False."""
    signal_to_noise: Float64[Tensor, "B"]
    """Ratio of the variances of signal and noise of every component, falling; below about 1 a component is noise."""


def minimum_noise_fractions(
    cube: Float[Tensor, "H W B"], mask: Bool[Tensor, "H W"], count: int
) -> NoiseFractions:
    """The first components of an image after Green et al. 1988, IEEE TGRS 26(1): minimum noise fractions.

    The noise is that of the differences between neighbours to the right, over the root of two: edges count as noise. It
    takes more pairs of neighbours than bands, and bands that have a noise of their own.
    """
    data, bands = cube.double(), cube.shape[-1]
    pairs = mask[:, 1:] & mask[:, :-1]
    steps = (data[:, 1:] - data[:, :-1])[pairs]
    if len(steps) <= bands:
        raise SpectrumError(f"the noise of {bands} bands takes more pairs of neighbours; found {len(steps)}")
    mean = data[mask].mean(dim=0)
    noise, total = (torch.cov(some.T).reshape(bands, bands) for some in (steps / 2**0.5, data[mask]))
    factor, failed = torch.linalg.cholesky_ex(noise)
    if failed or not factor.diagonal().min() > 1e-7 * factor.diagonal().max():
        raise SpectrumError(
            "some bands have no noise of their own (repeated, constant or made of others): leave them out for minimum "
            "noise fractions"
        )
    half = torch.linalg.solve_triangular(factor, total, upper=False)
    whitened = torch.linalg.solve_triangular(factor, half.T, upper=False)
    ratios, turned = torch.linalg.eigh((whitened + whitened.T) / 2)
    axes = torch.linalg.solve_triangular(factor.T, turned.flip(1)[:, :count], upper=True)
    axes = axes * axes.gather(0, axes.abs().argmax(dim=0, keepdim=True)).sign()  # the sign is arbitrary
    components = torch.zeros(*mask.shape, axes.shape[1], dtype=torch.float64)
    components[mask] = (data[mask] - mean) @ axes
    return NoiseFractions(components, ratios.flip(0) - 1)
