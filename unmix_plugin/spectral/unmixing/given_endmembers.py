"""Endmembers from a file, brought to the brightness of a scene.

Notation: `N` pixels, `B` bands, `K` endmembers.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.spectral.unmixing.abundance_estimation import nnls
from unmix_plugin.spectral.unmixing.endmembers import drop_uninformative_pixels

_LIT_QUANTILE = 0.99
_LIT_SCALE = 0.75
"""Scale that fully lit pixels should need: a sigmoid near 1 hardly learns (vnir-pots, 500 steps: +0.9 dB against 1)."""
_MOST_PIXELS = 5000


def brightness_factor(
    endmembers: Float[Tensor, "K B"], pixels: Float[Tensor, "N B"], generator: torch.Generator
) -> float:
    """The one factor on all endmembers with which nearly every pixel is a mixture of amounts that sum to at most 0.75.

    Spectra from a file are as bright as a white surface in the brightest band of the lamp; a scene's exposure is
    anything. Ratios between endmembers, which the file gives, stay.

    Args:
        endmembers: Reflectance times the lamp's relative power.
        pixels: Spectra of all training views.
        generator: On the CPU; chooses at most 5000 of them.
    Raises:
        SpectrumError: no pixel is a mixture of them.
    """
    usable = drop_uninformative_pixels(pixels)
    usable = usable[torch.randperm(len(usable), generator=generator)[:_MOST_PIXELS]]
    amounts = nnls(usable.double(), endmembers.double()).sum(dim=1)
    factor = float(torch.quantile(amounts, _LIT_QUANTILE)) / _LIT_SCALE if len(amounts) else 0.0
    if not factor > 0:
        raise SpectrumError("the given endmembers explain no pixel of the training views")
    return factor


def given_endmembers(
    path: Path,
    count: int,
    bands: Bands,
    lamp: Float[Tensor, "B"],
    pixels: Float[Tensor, "N B"],
    generator: torch.Generator,
) -> Float[Tensor, "K B"]:
    """Radiance of the reflectances in a CSV (wavelength,name,...), as bright as the scene.

    Args:
        path: The file.
        count: K, which must be the number of its spectra.
        bands: To resample to.
        lamp: Relative power of the scene's light.
        pixels: Spectra of all training views.
        generator: On the CPU.
    Raises:
        ConfigError: another number of spectra.
        SpectrumError: they don't cover the bands, or explain no pixel.
    """
    table = read_spectra_csv(path).resampled(bands)
    if len(table.names) != count:
        raise ConfigError(
            f"{path} has {len(table.names)} spectra but num-endmembers is {count}; give both the same number"
        )
    radiance = (torch.as_tensor(table.spectra, dtype=torch.float32) * lamp).clamp(min=0)
    return radiance * brightness_factor(radiance, pixels, generator)
