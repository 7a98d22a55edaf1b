"""The endmembers that a training starts from, and how they guide abundances.

They come from a file or are found in the training pixels. The model keeps the first ones: pixels are unmixed with them
one by one, and abundances are drawn to what is found.

Notation: `N` and `R` pixels, `K` endmembers, `B` bands of the scene, `b` channels of a sensor of a rig.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from unmix_plugin.sensors.batches import MeasuredPixels
from unmix_plugin.sensors.views import BandBalance, SensorViews
from unmix_plugin.settings import UnmixModelConfig
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA
from unmix_plugin.spectral.unmixing.endmembers import (
    distinct_spectra,
    fill_bands,
    given_endmembers,
    has_spectral_shape,
    initialise_endmembers,
)
from unmix_plugin.spectral.unmixing.mixture_guide import (
    MixtureCache,
    abundance_error,
    margin_error,
    margin_variance,
    mixing_penalty,
)

_OBSERVED_PIXELS = 256
"""Pixels of a batch by which the error of margins is followed."""
MIXING_PENALTY = 2.0
"""By how much a further material must improve the fit of a spectrum, in multiples of the mean angle that mixtures of
two leave unexplained where that is 0.02 rad; less where it is less, more where it is more."""


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
        self, pixels: Float[Tensor, "N b"], endmembers: Float[Tensor, "K B"], seen: Float[Tensor, "K b"]
    ) -> None:
        """Unmix with these endmembers, `seen` as the pixels are, from now on."""
        self.endmembers.copy_(endmembers)
        self.penalty.fill_(mixing_penalty(pixels, seen, MIXING_PENALTY))

    def error(
        self, abundances: Float[Tensor, "R K"], measured: MeasuredPixels, endmembers: Float[Tensor, "K b"]
    ) -> Float[Tensor, ""]:
        """Mean squared distance of composited abundances to what pixels are made of.

        Args:
            endmembers: The guide's, as the sensor of these pixels sees them.
        """
        mixtures = self._mixtures(measured, endmembers)
        return abundance_error(abundances, mixtures, measured.alpha, _is_informative(measured))

    def observe(
        self, abundances: Float[Tensor, "R K"], measured: MeasuredPixels, endmembers: Float[Tensor, "K b"]
    ) -> None:
        """Follow how far margins of composited abundances are from those of the measured spectra."""
        few = measured.first(_OBSERVED_PIXELS)
        counts = _is_informative(few) & (few.alpha > OPAQUE_ALPHA)
        own, mixtures = abundances[:_OBSERVED_PIXELS].detach(), self._mixtures(few, endmembers)
        self.margin_variance.copy_(margin_variance(self.margin_variance, own, mixtures, counts))

    def _mixtures(self, measured: MeasuredPixels, endmembers: Float[Tensor, "K b"]) -> Float[Tensor, "R K"]:
        if self._cache is None:
            self._cache = MixtureCache(len(self.endmembers), self.endmembers.device)
        return self._cache.mixtures(measured.pixels, measured.spectra, endmembers, self.penalty)


def _is_informative(measured: MeasuredPixels) -> Bool[Tensor, "R"]:
    found = has_spectral_shape(measured.spectra)
    return found if measured.alpha_trust is None else found & (measured.alpha_trust > 0)


def first_endmembers(
    config: UnmixModelConfig,
    count: int,
    balance: BandBalance,
    sensors: SensorViews,
    lamp: Float[Tensor, "B"],
    bands: Bands,
    initial_data: Mapping[str, np.ndarray],
    generator: torch.Generator,
) -> Float[Tensor, "K B"]:
    """The first endmembers, on all bands.

    Args:
        count: K.
        balance: What each band counts where pixels are compared.
        sensors: What the sensors of a rig see.
        lamp: Spectrum of the light, which reflectances of a file are multiplied by.
        initial_data: The data manager's summary of the training pixels.
    Raises:
        SpectrumError: more endmembers than distinct pixels, or spectra that don't cover the bands.
        ConfigError: the file has another number of spectra.
    """
    pixels, sensor = torch.from_numpy(initial_data["pixels"]), initial_data.get("sensor")
    if config.endmember_file is not None:
        everywhere = pixels if sensor is None else _on_all_bands(pixels, sensors, initial_data)
        return given_endmembers(config.endmember_file, count, bands, lamp, everywhere, generator)
    assert config.endmember_init != "file"
    if not sensors.tells_materials(sensor, count):
        return distinct_spectra(torch.from_numpy(initial_data["typical"]), count)
    balanced = balance.scaled(pixels, sensor)
    seen = balance.restored(initialise_endmembers(balanced, count, config.endmember_init, generator), sensor)
    return seen if sensor is None else _on_all_bands(seen, sensors, initial_data)


def first_specular_spectra(
    count: int, lamp: Float[Tensor, "B"], endmembers: Float[Tensor, "K B"]
) -> Float[Tensor, "count B"]:
    """The dictionary of gloss at the start: the lamp's spectrum, then the endmembers in turn."""
    rows = [lamp if row == 0 else endmembers[(row - 1) % len(endmembers)] for row in range(count)]
    return torch.stack(rows) if rows else endmembers[:0]


def _on_all_bands(
    seen: Float[Tensor, "N b"], sensors: SensorViews, initial_data: Mapping[str, np.ndarray]
) -> Float[Tensor, "N B"]:
    matrix = sensors.matrix(initial_data["sensor"]).cpu()
    return fill_bands(seen, matrix, torch.from_numpy(initial_data["typical"]))
