"""What the model keeps of measured spectra to guide its abundances; saved with it.

Notation: `R` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.spectral.evidence import OPAQUE_ALPHA
from unmix_plugin.spectral.unmixing.endmembers import has_spectral_shape
from unmix_plugin.spectral.unmixing.mixture_guide import (
    MixtureCache,
    abundance_error,
    margin_error,
    margin_variance,
    mixing_penalty,
)

_OBSERVED_PIXELS = 256
"""Pixels of a batch by which the error of margins is followed."""


class AbundanceGuide(nn.Module):
    """The first endmembers, with which pixels are unmixed one by one, and how far the field is from the result."""

    endmembers: Tensor
    penalty: Tensor
    margin_variance: Tensor

    def __init__(self, num_endmembers: int, num_bands: int) -> None:
        super().__init__()
        self.register_buffer("endmembers", torch.zeros(num_endmembers, num_bands))
        self.register_buffer("penalty", torch.zeros(()))
        self.register_buffer("margin_variance", torch.full((), torch.inf))
        self._cache: MixtureCache | None = None

    @property
    def margin_error(self) -> Float[Tensor, ""]:
        """Standard error of the margin of a ray's largest abundance over its second; infinite before any training."""
        return margin_error(self.margin_variance)

    def start(
        self,
        pixels: Float[Tensor, "N b"],
        endmembers: Float[Tensor, "K B"],
        relative_penalty: float,
        seen: Float[Tensor, "K b"],
    ) -> None:
        """Unmix with these endmembers, `seen` as the pixels are, from now on; the rest as `mixing_penalty` takes it."""
        self.endmembers.copy_(endmembers)
        self.penalty.fill_(mixing_penalty(pixels, seen, relative_penalty))

    def error(
        self, abundances: Float[Tensor, "R K"], batch: dict[str, Tensor], endmembers: Float[Tensor, "K b"]
    ) -> Float[Tensor, ""]:
        """Mean squared distance of composited abundances to what the pixels of a batch are made of.

        Args:
            endmembers: The guide's, as the sensor of these pixels sees them.
        """
        is_informative = has_spectral_shape(batch["spectra"])
        if "alpha_trust" in batch:
            is_informative &= batch["alpha_trust"] > 0
        mixtures = self._mixtures(batch, endmembers)
        return abundance_error(abundances, mixtures, batch["alpha"], is_informative)

    def observe(
        self, abundances: Float[Tensor, "R K"], batch: dict[str, Tensor], endmembers: Float[Tensor, "K b"]
    ) -> None:
        """Follow how far margins of composited abundances are from those of the measured spectra."""
        few = {name: values[:_OBSERVED_PIXELS] for name, values in batch.items()}
        counts = has_spectral_shape(few["spectra"]) & (few["alpha"] > OPAQUE_ALPHA)
        if "alpha_trust" in few:
            counts &= few["alpha_trust"] > 0
        found = margin_variance(
            self.margin_variance,
            abundances[:_OBSERVED_PIXELS].detach(),
            self._mixtures(few, endmembers),
            counts,
        )
        self.margin_variance.copy_(found)

    def _mixtures(self, batch: dict[str, Tensor], endmembers: Float[Tensor, "K b"]) -> Float[Tensor, "R K"]:
        if self._cache is None:
            self._cache = MixtureCache(len(self.endmembers), self.endmembers.device)
        return self._cache.mixtures(batch["pixels"], batch["spectra"], endmembers, self.penalty)
