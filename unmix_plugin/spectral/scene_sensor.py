"""What a camera makes of spectra: a linear operator from the scene's bands to the channels of its cubes.

Notation: `B` bands of the scene, `b` channels of a sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64


@dataclass(frozen=True, eq=False)
class SceneSensor:
    """A camera of a rig, or the only one; its frames have one size."""

    name: str
    """Unique in the scene."""
    matrix: Float64[np.ndarray, "b B"]
    """A channel's value is its row times the spectrum. Rows are not negative and sum to 1."""

    @staticmethod
    def of_bands(name: str, bands: tuple[int, ...], num_bands: int) -> SceneSensor:
        """A sensor whose channels are some bands of the scene, in any order."""
        return SceneSensor(name, np.eye(num_bands)[list(bands)])

    @cached_property
    def bands(self) -> tuple[int, ...] | None:
        """The band that each channel is; None where channels are means over several."""
        is_selection = ((self.matrix == 1).sum(axis=1) == 1) & ((self.matrix != 0).sum(axis=1) == 1)
        return tuple(self.matrix.argmax(axis=1).tolist()) if is_selection.all() else None

    @property
    def num_channels(self) -> int:
        """b."""
        return len(self.matrix)

    @property
    def sees_all_bands(self) -> bool:
        """Whether the channels are the scene's bands, in their order."""
        return self.bands == tuple(range(self.matrix.shape[1]))

    @property
    def seen_bands(self) -> Bool[np.ndarray, " B"]:
        """Bands that some channel responds to."""
        return np.any(self.matrix > 0, axis=0)

    @cached_property
    def false_colours(self) -> Float64[np.ndarray, "b 3"]:
        """From channels to red, green and blue, long waves red: each the mean of a third of the channels, or the
        nearest one."""
        centers = self.matrix @ np.arange(self.matrix.shape[1])
        order = np.argsort(np.argsort(centers, kind="stable"), kind="stable")
        middles = (np.array([2, 1, 0]) + 0.5) / 3 * len(centers) - 0.5
        distances = np.abs(order[:, None] - middles)
        near = distances <= np.maximum(distances.min(axis=0), len(centers) / 6)
        return near / near.sum(axis=0)

    def to_json(self) -> dict[str, Any]:
        """Name, and bands or responses; `from_json` restores the same bits."""
        if self.bands is not None:
            return {"name": self.name, "bands": list(self.bands)}
        return {"name": self.name, "responses": self.matrix.tolist()}

    @staticmethod
    def from_json(values: Mapping[str, Any], num_bands: int) -> SceneSensor:
        """The sensor that `to_json` wrote.

        Raises:
            KeyError, IndexError, TypeError, ValueError: no sensor of a scene with so many bands.
        """
        if "bands" in values:
            return SceneSensor.of_bands(str(values["name"]), tuple(values["bands"]), num_bands)
        matrix = np.array(values["responses"], dtype=np.float64)
        if matrix.ndim != 2 or matrix.shape[1] != num_bands or not matrix.min(initial=0.0) >= 0:
            raise ValueError(
                f"responses of shape {matrix.shape}; expected rows of {num_bands}, none negative"
            )
        return SceneSensor(str(values["name"]), matrix)
