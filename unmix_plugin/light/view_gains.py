"""Exposure and white balance of each training view, where they differ and nobody wrote them down.

A view's gain is smooth over the bands: exp of a polynomial of second degree in the wavelength. What all views have in
common is the scene's brightness, so the mean over views is taken out, and a new view has gain 1.

Notation: `V` training views, `R` rays, `B` bands, `b` channels of a sensor, `T` terms.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

NUM_TERMS = 3


def smooth_terms(wavelengths_nm: Float[Tensor, "B"]) -> Float[Tensor, "T B"]:
    """Legendre polynomials of degrees 0 to 2 over the bands' range."""
    low, high = wavelengths_nm.min(), wavelengths_nm.max()
    x = 2 * (wavelengths_nm - low) / (high - low).clamp(min=1e-6) - 1
    return torch.stack([torch.ones_like(x), x, (3 * x * x - 1) / 2])


class ViewGains(nn.Module):
    """A smooth gain for each training view; 1 at first."""

    terms: Tensor

    def __init__(self, num_views: int, wavelengths_nm: Float[Tensor, "B"]) -> None:
        super().__init__()
        self.log_gains = nn.Parameter(torch.zeros(num_views, NUM_TERMS))
        self.register_buffer("terms", smooth_terms(wavelengths_nm), persistent=False)

    def forward(self, views: Int[Tensor, "R"], terms: Float[Tensor, "T b"]) -> Float[Tensor, "R b"]:
        """Gains of the views that rays are of.

        Args:
            terms: The buffer of this name, as the rays' sensor sees it.
        """
        relative = self.log_gains - self.log_gains.mean(dim=0)
        return (relative.index_select(0, views) @ terms).exp()
