"""The images of a scene's cameras: each view as it was measured, in few pixels, read once for all pages."""

from __future__ import annotations

import threading

import numpy as np
import torch
from jaxtyping import UInt8

from unmix_plugin.formats.files import eight_bits
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix

_MOST_KEPT = 512


class Thumbnails:
    """Small sRGB images of the views of a scene, by name; may be asked by several threads."""

    def __init__(self, scene: Scene, rows: int = 96) -> None:
        """Images have at least so many rows, where the views do."""
        self._scene, self._rows = scene, rows
        self._index_of = {frame.name: index for index, frame in reversed(list(enumerate(scene.frames)))}
        self._kept: dict[str, UInt8[np.ndarray, "H W 3"]] = {}
        self._reading = threading.Lock()

    def of(self, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """A view as measured, every n-th pixel of it; None for a name that the scene does not have."""
        index = self._index_of.get(name)
        if index is None:
            return None
        with self._reading:
            if name not in self._kept:
                self._kept = dict([*self._kept.items(), (name, self._read(index))][-_MOST_KEPT:])
            return self._kept[name]

    def _read(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        scene = self._scene
        step = max(1, scene.cameras[index].height // self._rows)
        every = (slice(None, None, step), slice(None, None, step))
        picture = scene.srgb(index)
        if picture is not None:
            return np.ascontiguousarray(eight_bits(picture[every]))
        sensor, spectra = scene.sensor_of(index), torch.from_numpy(scene.cube(index, every))
        weights = torch.from_numpy(sensor.false_colours)
        if sensor.sees_all_bands:
            weights = rgb_matrix(Bands.of(scene.wavelengths_nm))
        return eight_bits(linear_to_srgb((spectra @ weights.to(spectra)).clamp(0, 1)).numpy())
