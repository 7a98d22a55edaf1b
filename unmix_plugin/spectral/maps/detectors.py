"""Detectors of a known spectrum before a background of known mean and covariance.

Notation: `B` bands, `N` pixels of the background, `*rays` any leading axes; spectra x, target t, all in one unit. The
background has mean m and covariance S = C + d trace(C) / B, C the sample covariance, d `LOADING`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.errors import SpectrumError

LOADING = 1e-3
"""Added to the covariance's diagonal, in mean variances of a band: a target may differ from how it is rendered by about
3% of the background's standard deviation in each band. Rendered spectra are mixtures of a few and vary in no other
direction, so that with much less, the smallest difference makes the target unlike everything in view; with much more,
similar materials can no longer be told apart. Chosen on rendered views against true reflectances of seven materials."""


@dataclass(frozen=True)
class Background:
    """Mean of what else there is, and the map after which it varies alike in all directions."""

    mean: Float[Tensor, "B"]
    whitening: Float[Tensor, "B B"]
    """W with W S W^T = 1: inverse of the lower Cholesky factor of S. Both float64."""

    @staticmethod
    def fit(spectra: Float[Tensor, "N B"]) -> Background:
        """Of a sample of pixels; those not finite or zero in all bands do not count.

        Raises:
            SpectrumError: fewer than two pixels that count, or all are equal.
        """
        counted = spectra[is_defined(spectra)].double()
        if len(counted) < 2:
            raise SpectrumError(
                f"the background has {len(counted)} pixels in which something is and its reflectance is known in all "
                "bands (2 or more needed); choose views that show more, or the spectral angle"
            )
        mean = counted.mean(dim=0)
        centred = counted - mean
        covariance = centred.T @ centred / (len(counted) - 1)
        variance = covariance.diagonal().mean()
        if not variance > 1e-12 * mean.square().mean():
            raise SpectrumError(
                f"all {len(counted)} pixels of the background are equal, so nothing stands out from it; choose views "
                "that show more, or the spectral angle"
            )
        identity = torch.eye(len(mean)).to(covariance)
        factor = torch.linalg.cholesky(covariance + LOADING * variance * identity)
        return Background(mean, torch.linalg.solve_triangular(factor, identity, upper=False))

    def whiten(self, spectra: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays B"]:
        """W (x - m), float64: lengths and angles in these coordinates are those of S^-1."""
        return (spectra.double() - self.mean) @ self.whitening.T


def is_defined(spectra: Float[Tensor, "*rays B"]) -> Bool[Tensor, "*rays"]:
    """Which spectra are finite in all bands and not zero in all."""
    return spectra.isfinite().all(dim=-1) & (spectra != 0).any(dim=-1)


def matched_filter(
    spectra: Float[Tensor, "*rays B"], target: Float[Tensor, "B"], background: Background
) -> Float[Tensor, "*rays"]:
    """(x - m)^T S^-1 (t - m) / ((t - m)^T S^-1 (t - m)): 1 for the target t, 0 for the background's mean, float64.

    Source: Manolakis, Marden and Shaw 2003, Lincoln Laboratory Journal 14(1), as normalised by Eismann 2012.
    """
    wanted = background.whiten(target)
    return background.whiten(spectra) @ (wanted / wanted.square().sum())


def adaptive_coherence(
    spectra: Float[Tensor, "*rays B"], target: Float[Tensor, "B"], background: Background
) -> Float[Tensor, "*rays"]:
    """Squared cosine between x - m and t - m under S^-1, [0, 1], float64; NaN for the background's mean.

    0 where the cosine is negative: the square alone would find the opposite of the target too.

    Source:
        Scharf and McWhorter 1996, Adaptive matched subspace detectors and adaptive coherence estimators; Kraut, Scharf
        and Butler 2005, IEEE Trans. Signal Processing 53(2).
    """
    wanted, found = background.whiten(target), background.whiten(spectra)
    lengths = wanted.norm() * found.norm(dim=-1)
    return (found @ wanted / lengths).clamp(0, 1).square()
