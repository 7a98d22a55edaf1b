"""Noise of spectra, from what their bands can't tell of each other.

Notation: `N` pixels, `B` bands.

Source: J. M. Bioucas-Dias and J. M. P. Nascimento, "Hyperspectral Subspace Identification", IEEE TGRS 46(8), 2008.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def estimate_noise(pixels: Float[Tensor, "N B"]) -> Float[Tensor, "N B"]:
    """What of each band the other bands can't predict linearly (Bioucas-Dias and Nascimento 2008, algorithm 1)."""
    data = pixels.double()
    num_bands = data.shape[1]
    correlation = data.T @ data
    # A trace on the diagonal keeps bands that depend on each other exactly from being inverted into infinities.
    trace = 1e-12 * correlation.diagonal().mean().clamp(min=1e-300)
    inverse = torch.linalg.inv(correlation + trace * torch.eye(num_bands).to(data))
    # By the block inverse, row b of the inverse divided by its diagonal holds 1 and minus the coefficients of band b.
    residual = data @ (inverse / inverse.diagonal()[:, None]).T
    return residual.to(pixels.dtype)
