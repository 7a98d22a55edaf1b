"""What measured spectra, unmixed one by one, say about the abundances of a field.

A rendered spectrum is never exact, and where endmembers resemble mixtures of each other a small error in a spectrum is
a large one in its mixture. Measured spectra are the better witnesses; a field that must agree with all of them takes
the mean over views, in which noise and highlights that wander over a surface lose.

Notation: `R` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.spectral.endmembers import drop_uninformative_pixels, shows_a_shape
from unmix_plugin.spectral.sparse_unmixing import sparse_abundances
from unmix_plugin.spectral.two_material_mixtures import mean_pair_distance


class MixtureGuide(nn.Module):
    """Endmembers to unmix with, and how much a further material must explain to be believed; saved with the model."""

    endmembers: Tensor
    mixing_penalty: Tensor

    def __init__(self, num_endmembers: int, num_bands: int) -> None:
        super().__init__()
        self.register_buffer("endmembers", torch.zeros(num_endmembers, num_bands))
        self.register_buffer("mixing_penalty", torch.zeros(()))

    def start(
        self, pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"], relative_penalty: float
    ) -> None:
        """Unmix with these endmembers from now on.

        Args:
            pixels: Spectra of all training views.
            relative_penalty: The mixing penalty in multiples of the mean angle that mixtures of two materials leave
                unexplained: where light is coloured by what it met before, that angle and the penalty are larger.
        """
        self.endmembers.copy_(endmembers)
        unexplained = mean_pair_distance(drop_uninformative_pixels(pixels), endmembers.to(pixels))
        self.mixing_penalty.fill_(relative_penalty * unexplained)

    def error(
        self, abundances: Float[Tensor, "R K"], measured: Float[Tensor, "R B"], alpha: Float[Tensor, "R"]
    ) -> Float[Tensor, ""]:
        """Mean squared distance of abundances to those of measured spectra; black and saturated ones say nothing.

        Args:
            abundances: Composited, so that they sum to the opacity.
            measured: Premultiplied by `alpha`.
        """
        mixtures = sparse_abundances(measured, self.endmembers, self.mixing_penalty)
        distances = (abundances - alpha[:, None] * mixtures).square().sum(dim=1)
        return (shows_a_shape(measured) * distances).mean()
