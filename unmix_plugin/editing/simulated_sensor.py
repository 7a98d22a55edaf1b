"""A model seen through another camera: its spectra have a value for each channel of a sensor.

A rendered spectrum is linear in endmembers and specular spectra, and so is what a sensor makes of it: both are seen
through the sensor once, and everything that renders them works as before. Radiance and light become the channels' means
of them, neither of them rescaled, so that their ratio stays reflectance: the mean of the reflectance, weighted with
response and light.

Notation: `B` bands, `S` channels, `K` endmembers, `J` specular spectra.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from unmix_plugin.editing.apply import edit_model
from unmix_plugin.editing.recipe import Recipe
from unmix_plugin.model import UnmixModel
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.sensor import Sensor


def with_sensor(model: UnmixModel, sensor: Sensor) -> tuple[UnmixModel, list[str]]:
    """The model as the sensor sees it, and what a user has to be told of that.

    Abundances and geometry are the model's, whose weights it shares; `model` stays as it is. The result is for
    rendering: it can be neither trained nor edited, since edits and lights need the bands.

    Raises:
        SpectrumError: no channel of the sensor lies in what the model's bands cover.
    """
    seen = sensor.seen_by(model.bands)
    through = edit_model(model, Recipe())  # changes nothing: a copy that shares what is heavy
    through.bands = seen.bands
    through.endmembers = _frozen(_through(model.endmembers, seen.matrix))
    through.specular_spectra = _frozen(_through(model.specular_spectra, seen.matrix))
    through.every_band = _through(model.every_band, seen.matrix)
    through.rgb_weights = rgb_matrix(seen.bands).to(model.device)
    light = model.metadata["illuminant"]
    through.metadata = {
        **model.metadata,
        "wavelengths_nm": seen.bands.centers_nm.tolist(),
        "illuminant": None if light is None else (np.array(light, dtype=np.float64) @ seen.matrix).tolist(),
    }
    return through, [seen.description, *seen.notes]


def _through(spectra: Float[Tensor, "N B"], matrix: Float64[np.ndarray, "B S"]) -> Float[Tensor, "N S"]:
    return (spectra.detach().cpu().double() @ torch.from_numpy(matrix)).to(spectra)


def _frozen(spectra: Float[Tensor, "N S"]) -> nn.Parameter:
    return nn.Parameter(spectra, requires_grad=False)
