"""The spectra that a training starts from: endmembers from a file or found in the training pixels, and those of gloss.

Notation: `N` pixels, `K` endmembers, `B` bands of the scene, `b` channels of a sensor of a rig.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.model_settings import UnmixModelConfig
from unmix_plugin.sensors.band_balance import BandBalance
from unmix_plugin.sensors.views import SensorViews
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.unmixing.endmembers import (
    distinct_spectra,
    fill_bands,
    given_endmembers,
    initialise_endmembers,
)


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
