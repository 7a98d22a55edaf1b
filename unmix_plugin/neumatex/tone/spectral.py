"""Spectra as numbers that are compared or shown.

Notation: `B` bands.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import agx, rgb_matrix

_DARK = 0.25
"""Brightness, as a part of the mean, far below which pixels count alike."""


class LampRatio(nn.Module):
    """Light over the lamp's power, so that all bands count by their reflectance; above 1 its logarithm, plus 1, so that
    highlights do not outweigh everything else.

    It is straight where nearly all light is: a curve that bends makes noisy estimates look too dark on average, and
    materials, dark ones most, would be fitted too bright.
    """

    lamp: Tensor

    def __init__(self, lamp: Sequence[float]) -> None:
        """
        Args:
            lamp: Power of each band, above 0.
        """
        super().__init__()
        self.register_buffer("lamp", torch.tensor(lamp, dtype=torch.float32), persistent=False)

    def forward(self, light: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels B"]:
        """Numbers of at least 0."""
        ratio = light / self.lamp
        return torch.where(ratio < 1, ratio, 1 + ratio.clamp(min=1).log())

    def weights(self, light: Float[Tensor, "R B"]) -> Float[Tensor, "R 1"]:
        """Of errors of a picture's pixels, with which relative errors count: else materials that are dark or in the
        shade would be fitted last. Pixels far darker than the mean get no more, since they hold little but noise.

        Weights follow from the picture alone, so that the noise of rendered light makes no bias; the mean of their
        squares is 1.
        """
        brightness = (light / self.lamp).mean(dim=-1, keepdim=True).clamp(min=0)
        weights = 1 / (_DARK * brightness.mean().clamp(min=1e-6) + brightness)
        return weights / weights.square().mean().sqrt()


class SpectralDisplay(nn.Module):
    """Spectra as AgX shows their colour; the flat spectrum 1 is white."""

    matrix: Tensor

    def __init__(self, bands: Bands) -> None:
        """For spectra of these bands."""
        super().__init__()
        self.register_buffer("matrix", rgb_matrix(bands), persistent=False)

    def rgb(self, spectra: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels 3"]:
        """Linear colour, at least 0."""
        return (spectra @ self.matrix).clamp(min=0)

    def forward(self, light: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels 3"]:
        """sRGB numbers in [0, 1]."""
        return agx(self.rgb(light)).clamp(0, 1)
