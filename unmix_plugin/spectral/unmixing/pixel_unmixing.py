"""Endmembers and abundances of pixels taken one by one: an image without its scene.

Notation: `N` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.spectral.unmixing.abundance_estimation import nnls
from unmix_plugin.spectral.unmixing.endmembers import EndmemberMethod, initialise_endmembers

_DARK_MATERIAL = 0.25
"""Length of the darkest endmember, as a share of the brightest, below which brightness does not decide amounts."""


def unmix_pixels(
    pixels: Float[Tensor, "N B"],
    num_endmembers: int,
    generator: torch.Generator,
    method: EndmemberMethod = "pooled-pairs",
) -> tuple[Float[Tensor, "K B"], Float[Tensor, "N K"]]:
    """Endmembers of these pixels, and their abundances, at least 0 with sum 1; zeros for black pixels.

    Shading is ignored: abundances are shares of the non-negative least squares amounts.

    Args:
        pixels: In [0, 1]; saturated ones (1 or above) do not decide the endmembers.
        generator: On the CPU; the only source of randomness.
    Raises:
        SpectrumError: as `initialise_endmembers`.
    """
    endmembers = comparable_brightness(initialise_endmembers(pixels, num_endmembers, method, generator))
    amounts = nnls(pixels, endmembers)
    return endmembers, amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)


def comparable_brightness(endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "K B"]:
    """The endmembers; all with the largest peak of any if one is less than a quarter as long as the longest.

    Amounts are in units of their endmember. In units of one that is nearly black, such as water in the near infrared,
    haze, glint and light from the neighbourhood become large amounts, so shares are then counted between spectra of
    one peak, as the reference maps of Samson count them.
    """
    lengths, peaks = endmembers.norm(dim=1), endmembers.amax(dim=1, keepdim=True)
    if bool(lengths.min() >= _DARK_MATERIAL * lengths.max()):
        return endmembers
    return endmembers * (peaks.max() / peaks.clamp(min=1e-12))
