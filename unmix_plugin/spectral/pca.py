"""Principal components of spectra as colours, with one basis and one stretch for all pictures that are compared.

Notation: `B` bands, `N` spectra, `*rays` any leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_FEWEST_SPECTRA = 4
"""Spectra that three components need."""

_STRETCH = (0.01, 0.99)
"""Quantiles of a component that become 0 and 1."""


@dataclass(frozen=True)
class PcaColours:
    """A map from spectra to three numbers in [0, 1]."""

    mean: Float[Tensor, "B"]
    axes: Float[Tensor, "B 3"]
    """The three directions of largest variance, unit vectors; 0 where there are fewer."""
    low: Float[Tensor, "3"]
    """Components that become 0."""
    high: Float[Tensor, "3"]
    """Components that become 1."""

    @staticmethod
    def fit(spectra: Float[Tensor, "N B"]) -> PcaColours:
        """The map for these spectra: each component is stretched between its 1st and 99th percentile.

        Fewer than four spectra have no components: the map then gives 0.
        """
        num_bands = spectra.shape[1]
        flat = spectra.new_zeros(num_bands, 3)
        if len(spectra) < _FEWEST_SPECTRA:
            return PcaColours(flat[:, 0], flat, flat[0], flat[0])
        mean = spectra.mean(dim=0)
        centred = spectra - mean
        axes = torch.linalg.eigh(centred.T @ centred)[1][:, -3:].flip(-1)
        # The sign of an eigenvector is arbitrary: its largest component is made positive.
        axes = axes * axes.gather(0, axes.abs().argmax(dim=0, keepdim=True)).sign()
        axes = torch.cat([axes, flat[:, axes.shape[1] :]], dim=1)
        low, high = torch.quantile(centred @ axes, torch.tensor(_STRETCH).to(spectra), dim=0)
        return PcaColours(mean, axes, low, high)

    def __call__(self, spectra: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays 3"]:
        """Colours of spectra."""
        components = (spectra - self.mean) @ self.axes
        return ((components - self.low) / (self.high - self.low).clamp(min=1e-9)).clamp(0, 1)
