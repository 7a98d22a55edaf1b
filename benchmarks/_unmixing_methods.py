"""Methods that unmix single pixels: how each finds endmembers, and how it explains pixels by them.

All get the same chances: five draws, of which the best by the method's own measure stays; the same pixels without dark
and saturated ones; endmembers as bright as the pixels like them, or of one peak where one is nearly black. FCLS, whose
shares sum to 1 in any shade, gets pixels and endmembers of one brightness.

Notation: `N` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from unmix_plugin.losses.abundance_guide import mixing_penalty
from unmix_plugin.spectral.segmentation import material_scores
from unmix_plugin.spectral.unmixing.abundances import fcls, nnls, sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import (
    EndmemberMethod,
    comparable_brightness,
    drop_uninformative_pixels,
    initialise_endmembers,
)

Explain = Callable[[Tensor, Tensor], Tensor]
"""From pixels (N, B) and endmembers (K, B) to amounts (N, K)."""

OURS = "pooled, NNLS"
"""The row of `unmix_image`, with its defaults."""

_RESTARTS = 5
_LARGEST_SAMPLE = 20_000
"""Training pixels that k-means of raw spectra sees, as many as the other methods."""


@dataclass(frozen=True)
class PixelMethod:
    """How endmembers are found and pixels explained."""

    find: EndmemberMethod | Literal["raw k-means", "truth"]
    explain: Explain | Literal["few"]
    """`few`: mixtures of few materials, as those that guide a field in training."""

    @property
    def is_oracle(self) -> bool:
        """Whether it is told what the others have to find."""
        return self.find == "truth"

    def explainer(self, training: Tensor, endmembers: Tensor) -> Explain:
        """How it explains pixels, given those that endmembers were found in."""
        return _by_few(training, endmembers) if self.explain == "few" else self.explain


def find_endmembers(pixels: Tensor, count: int, find: str, generator: torch.Generator) -> Tensor:
    """Endmembers (K, B) by a method that is not an oracle.

    Raises:
        SpectrumError: as `initialise_endmembers`.
    """
    if find == "raw k-means":
        return _raw_kmeans(drop_uninformative_pixels(pixels), count, generator)
    return comparable_brightness(initialise_endmembers(pixels, count, find, generator))  # type: ignore[arg-type]


def _by_angle(pixels: Tensor, endmembers: Tensor) -> Tensor:
    """All of a pixel is the endmember of smallest angle, as bright as fits best."""
    return _one_each(pixels, endmembers, material_scores(pixels, endmembers).argmax(dim=1))


def _by_distance(pixels: Tensor, endmembers: Tensor) -> Tensor:
    """All of a pixel is the nearest endmember."""
    nearest = torch.cdist(pixels, endmembers).argmin(dim=1)
    return torch.nn.functional.one_hot(nearest, len(endmembers)).to(pixels)


def _scaled_fcls(pixels: Tensor, endmembers: Tensor) -> Tensor:
    """FCLS of spectra of sum 1, back in the pixels' units."""
    sums = pixels.sum(dim=1, keepdim=True).clamp(min=1e-9)
    endmember_sums = endmembers.sum(dim=1, keepdim=True).clamp(min=1e-9)
    return fcls(pixels / sums, endmembers / endmember_sums) * sums / endmember_sums.T


def _by_few(training: Tensor, endmembers: Tensor) -> Explain:
    """A pixel is a mixture of few endmembers, as bright as fits best; how few, the training pixels say."""
    penalty = mixing_penalty(training, endmembers)

    def explain(pixels: Tensor, spectra: Tensor) -> Tensor:
        shares = sparse_abundances(pixels, spectra, penalty)
        return shares * _best_lengths(pixels, shares @ spectra)[:, None]

    return explain


def _raw_kmeans(pixels: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Mean spectra of clusters by distance, where a shadow is as good a reason for a cluster as a material.

    The best of several restarts from pixels drawn at random.
    """
    pixels = pixels[torch.randperm(len(pixels), generator=generator)[:_LARGEST_SAMPLE]]
    best, least = pixels[:count], float("inf")
    for _ in range(_RESTARTS):
        centres = pixels[torch.randperm(len(pixels), generator=generator)[:count]]
        ids = torch.full((len(pixels),), -1)
        for _ in range(100):
            before, ids = ids, torch.cdist(pixels, centres).argmin(dim=1)
            if torch.equal(before, ids):
                break
            sums = torch.zeros_like(centres).index_add_(0, ids, pixels)
            sizes = torch.bincount(ids, minlength=count)[:, None]
            centres = torch.where(sizes > 0, sums / sizes.clamp(min=1), centres)
        cost = float((pixels - centres[ids]).square().sum())
        if cost < least:
            best, least = centres, cost
    return best


def _one_each(pixels: Tensor, endmembers: Tensor, ids: Tensor) -> Tensor:
    one_hot = torch.nn.functional.one_hot(ids, len(endmembers)).to(pixels)
    return one_hot * _best_lengths(pixels, endmembers[ids])[:, None]


def _best_lengths(pixels: Tensor, spectra: Tensor) -> Tensor:
    """How often each pixel's own spectrum must be taken; a trace for a black pixel, as shares must sum to 1."""
    lengths = (pixels * spectra).sum(dim=1) / spectra.square().sum(dim=1).clamp(min=1e-12)
    return lengths.clamp(min=1e-9)


def _sunsal(pixels: Tensor, endmembers: Tensor, sparsity: float = 1e-3) -> Tensor:
    """Sparse amounts a >= 0 that minimise |E^T a - x|^2 / 2 + sparsity sum(a).

    SUnSAL (constrained basis pursuit denoising by alternating directions), J. M. Bioucas-Dias and M. A. T. Figueiredo,
    WHISPERS 2010, algorithm 1 with the positivity constraint. It ends when no amount differs by more than a millionth
    of the largest between the two halves of the splitting, nor moves by more in a step.
    """
    spectra = endmembers.double()
    gram, loads = spectra @ spectra.T, pixels.double() @ spectra.T
    # The geometric mean of the extreme curvatures converges fastest on quadratics (Ghadimi et al., IEEE TAC 2015).
    curvatures = torch.linalg.eigvalsh(gram)
    top = curvatures[-1].clamp(min=1e-12)
    step = float((top * curvatures[0].clamp(min=1e-6 * top)).sqrt())
    inverse = torch.linalg.inv(gram + step * torch.eye(len(gram)).to(gram))
    split, dual = torch.zeros_like(loads), torch.zeros_like(loads)
    for _ in range(2000):
        amounts = (loads + step * (split - dual)) @ inverse
        previous, split = split, (amounts + dual - sparsity / step).clamp(min=0)
        dual = dual + amounts - split
        moved = torch.maximum((split - previous).abs(), (split - amounts).abs())
        if len(moved) == 0 or float(moved.max()) <= 1e-6 * float(split.max().clamp(min=1e-12)):
            break
    return split.to(pixels.dtype)


_EXPLAINED: dict[str, Explain | Literal["few"]] = {
    "probe": _by_angle,
    "NNLS": nnls,
    "FCLS": _scaled_fcls,
    "SUnSAL": _sunsal,
    "few": "few",
}
_FOUND: dict[str, EndmemberMethod | Literal["truth"]] = {
    "k-means": "kmeans",
    "VCA": "vca",
    "N-FINDR": "nfindr",
    "minimum volume": "minimum-volume",
    "pairs": "pairs",
    "pooled": "pooled",
    "oracle": "truth",
}
METHODS: dict[str, PixelMethod] = {"k-means of raw spectra": PixelMethod("raw k-means", _by_distance)} | {
    f"{finder}, {name}": PixelMethod(find, explain)
    for finder, find in _FOUND.items()
    for name, explain in _EXPLAINED.items()
}
"""By the name of their row. The probe takes the endmember of smallest angle."""
