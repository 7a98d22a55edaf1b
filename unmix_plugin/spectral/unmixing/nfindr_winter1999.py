"""N-FINDR: the pixels that span the largest simplex.

Source: M. E. Winter, "N-FINDR: an algorithm for fast autonomous spectral end-member determination in hyperspectral
data", Proc. SPIE 3753, 1999. The start is VCA's choice rather than random pixels, which saves most replacements.

Notation: `N` pixels, `B` bands, `K` endmembers. The simplex lives in the K - 1 first principal components; a pixel's
`lifted` coordinates are those with a 1 in front, so that K! times the volume of K pixels' simplex is |det lifted|.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.unmixing.vca_nascimento2005 import vca

_MIN_GAIN = 1e-9
"""Least relative growth of the volume that counts: rounding errors must not swap equal pixels forever."""


def nfindr(
    pixels: Float[Tensor, "N B"],
    num_endmembers: int,
    generator: torch.Generator,
    max_sweeps: int = 10,
    restarts: int = 5,
) -> Int[Tensor, " K"]:
    """Indices of the pixels whose simplex has (locally) the largest volume; the best of several restarts.

    Args:
        pixels: Spectra in one unit. Brightness counts: scale spectra to one brightness to ignore shading.
        generator: On the CPU; seeds the start.
        max_sweeps: A sweep replaces each of the K endmembers in turn by the pixel that makes the volume largest. 1 is
            Winter's single replacement; more go on until a sweep changes nothing.
    Raises:
        SpectrumError: K below 2, above the bands or the pixels, or the pixels' simplex is flat in K - 1 dimensions.
    """
    lifted = _lifted_components(pixels.double(), num_endmembers)
    runs = []
    for _ in range(restarts):
        # VCA on principal components (its branch for noise) starts with corners of a simplex that is not flat.
        start = vca(pixels, num_endmembers, generator, snr_db=-math.inf).indices
        runs.append(_swept(lifted, start, max_sweeps))
    return max(runs, key=lambda indices: float(torch.linalg.det(lifted[indices]).abs()))


def _swept(lifted: Tensor, indices: Tensor, max_sweeps: int) -> Int[Tensor, " K"]:
    for _ in range(max_sweeps):
        before = indices
        for corner in range(len(indices)):
            indices = _replace_corner(lifted, indices, corner)
        if torch.equal(before, indices):
            break
    return indices


def simplex_volume(points: Float[Tensor, "K D"]) -> Float[Tensor, ""]:
    """Volume of the simplex whose K corners are the rows, in D = K - 1 dimensions.

    >>> simplex_volume(torch.tensor([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]]))
    tensor(3.)
    """
    num_dimensions = points.shape[1]
    factorial = torch.arange(1, num_dimensions + 1, dtype=points.dtype).prod()
    return torch.linalg.det(points[1:] - points[0]).abs() / factorial


def _lifted_components(data: Tensor, num_endmembers: int) -> Float[Tensor, "N K"]:
    """A 1, then K - 1 principal components scaled to one variance (which scales all volumes alike)."""
    centred = data - data.mean(dim=0)
    eigen = torch.linalg.eigh(centred.T @ centred / len(data))
    deviations = eigen.eigenvalues.flip(0)[: num_endmembers - 1].clamp(min=0).sqrt()
    if not deviations[-1] > 1e-7 * data.square().mean().sqrt():
        spanned = int((deviations > 1e-7 * data.square().mean().sqrt()).sum()) + 1
        raise SpectrumError(
            f"the pixels' simplex has only {spanned} corners: {num_endmembers} endmembers were asked for; "
            f"ask for at most {spanned}"
        )
    components = centred @ eigen.eigenvectors.flip(1)[:, : num_endmembers - 1] / deviations
    return torch.cat([components.new_ones(len(data), 1), components], dim=1)


def _replace_corner(lifted: Tensor, indices: Tensor, corner: int) -> Tensor:
    """Swap one corner for the pixel that makes the volume largest.

    The determinant is linear in each row: with row `corner` replaced by x it is det(S) times column `corner` of
    inverse(S) . x, so one product gives the growth that every pixel would bring.
    """
    growth = (lifted @ torch.linalg.inv(lifted[indices])[:, corner]).abs()
    best = int(growth.argmax())
    if growth[best] <= 1 + _MIN_GAIN:
        return indices
    replaced = indices.clone()
    replaced[corner] = best
    return replaced
