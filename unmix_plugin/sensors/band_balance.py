"""Weights of the bands where some are much noisier than others.

Errors of spectra are weighted in the loss. Where spectra are compared by angle, as in unmixing, they are multiplied by
the roots of the weights first, so that squared distances carry the weights.

Notation: `B` bands of the scene, `b` channels of a sensor, `R` pixels.
"""

from __future__ import annotations

from typing import SupportsInt

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError
from unmix_plugin.sensors.views import SensorViews
from unmix_plugin.spectral.bands import Bands


class BandBalance(nn.Module):
    """What each band counts; changes nothing where all count alike."""

    weights: Tensor

    def __init__(self, weights: tuple[float, ...], bands: Bands, seen_by: SensorViews) -> None:
        """
        Args:
            weights: One a band; none where all count alike.
            seen_by: What the sensors of a rig see.
        Raises:
            ConfigError: another number of weights than bands.
        """
        super().__init__()
        if len(weights) not in (0, len(bands)):
            raise ConfigError(
                f"losses.band-weights has {len(weights)} numbers; expected {len(bands)}, one a band, or none"
            )
        self._is_even = not weights
        self.register_buffer("weights", torch.tensor(weights), persistent=False)
        self._seen_by = [seen_by]  # in a list, so that it does not become a part of this module

    def of(self, sensor: SupportsInt | None) -> Float[Tensor, " b"] | None:
        """Weights of a sensor's channels; None where all count alike."""
        return None if self._is_even else self._seen_by[0].project(self.weights, sensor)

    def scaled(self, spectra: Float[Tensor, "R b"], sensor: SupportsInt | None) -> Float[Tensor, "R b"]:
        """Spectra times the roots of the weights over the largest."""
        weights = self.of(sensor)
        return spectra if weights is None else spectra * (weights / weights.max()).sqrt().to(spectra)

    def restored(self, spectra: Float[Tensor, "R b"], sensor: SupportsInt | None) -> Float[Tensor, "R b"]:
        """Undoes `scaled`, within [0, 1]."""
        weights = self.of(sensor)
        if weights is None:
            return spectra
        return (spectra / (weights / weights.max()).sqrt().to(spectra)).clamp(0, 1)

    def batch(self, batch: dict[str, Tensor], sensor: SupportsInt | None) -> dict[str, Tensor]:
        """A batch with scaled spectra."""
        return batch if self._is_even else {**batch, "spectra": self.scaled(batch["spectra"], sensor)}
