"""A scene seen through another camera: its spectra have a value for each channel of a sensor.

A rendered spectrum is linear in endmembers and specular spectra, and so is what a sensor makes of it: both are seen
through the sensor once. Radiance and light become the channels' means of them, neither of them rescaled, so that their
ratio stays reflectance: the mean of the reflectance, weighted with response and light.

Notation: `B` bands, `S` channels, `K` endmembers, `J` specular spectra.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.spectral.sensor import Sensor
from unmix_plugin.trained.trained_scene import TrainedScene


def with_sensor(scene: TrainedScene, sensor: Sensor) -> TrainedScene:
    """The scene as the sensor sees it; its `notes` say what of the sensor the bands do not cover.

    The result can't be edited any more: edits and lights need the bands.

    Raises:
        SpectrumError: no channel of the sensor lies in what the scene's bands cover.
    """
    seen, materials = sensor.seen_by(scene.bands), scene.materials
    through = replace(
        materials,
        bands=seen.bands,
        endmembers=_through(materials.endmembers, seen.matrix),
        specular_spectra=_through(materials.specular_spectra, seen.matrix),
        light=None if materials.light is None else _through(materials.light, seen.matrix),
    )
    return replace(scene, materials=through, notes=(*scene.notes, seen.description, *seen.notes))


def _through(spectra: Float[Tensor, "*n B"], matrix: Float64[np.ndarray, "B S"]) -> Float[Tensor, "*n S"]:
    return (spectra.detach().cpu().double() @ torch.from_numpy(matrix)).to(spectra)
