"""What the sensors of a rig see of spectra on all bands, on the model's device.

Notation: `B` bands of the scene, `b` channels of a sensor, `K` endmembers. A sensor None is a scene's only, ordinary
camera, which sees spectra as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, SupportsInt

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.spectral.sensor import SceneSensor

_FEWEST_CHANNELS = 3
"""Of a sensor whose spectra tell materials apart."""


class SensorViews(nn.Module):
    """Operators of a scene's sensors; false where it has one ordinary camera."""

    def __init__(self, sensors: Sequence[Mapping[str, Any]], rgb_weights: Float[Tensor, "B 3"]) -> None:
        """
        Args:
            sensors: As `SceneSensor.to_json` gives them.
            rgb_weights: From a spectrum on all bands to linear sRGB.
        """
        super().__init__()
        self.sensor_names = [str(values["name"]) for values in sensors]
        self._names = [f"matrix_{index}" for index in range(len(sensors))]
        for index, values in enumerate(sensors):
            sensor = SceneSensor.from_json(values, len(rgb_weights))
            matrix = torch.from_numpy(sensor.matrix).float()
            false_colours = torch.from_numpy(sensor.false_colours).float()
            colours = rgb_weights if sensor.sees_all_bands else false_colours
            self.register_buffer(f"matrix_{index}", matrix, persistent=False)
            self.register_buffer(f"colours_{index}", colours.clone(), persistent=False)
        self.register_buffer("plain_colours", rgb_weights.clone(), persistent=False)

    def __bool__(self) -> bool:
        return bool(self._names)

    def matrix(self, sensor: SupportsInt) -> Float[Tensor, "b B"]:
        """Operator of a sensor."""
        return self.get_buffer(self._names[int(sensor)])

    def num_channels(self, sensor: int) -> int:
        """b."""
        return len(self.matrix(sensor))

    def project(
        self, spectra: Float[Tensor, "*rows B"], sensor: SupportsInt | None
    ) -> Float[Tensor, "*rows b"]:
        """Spectra as a sensor sees them."""
        return spectra if sensor is None else spectra @ self.matrix(sensor).T.to(spectra)

    def rgb_weights(self, sensor: int | None) -> Float[Tensor, "b 3"]:
        """From channels to colours: sRGB where all bands are seen, otherwise false colours."""
        return self.get_buffer("plain_colours" if sensor is None else f"colours_{sensor}")

    def tells_materials(self, sensor: SupportsInt | None, num_endmembers: int) -> bool:
        """Whether a pixel alone can be unmixed: it has as many channels as there are endmembers, and at least 3."""
        return sensor is None or self.num_channels(int(sensor)) >= max(num_endmembers, _FEWEST_CHANNELS)

    def warnings(self, num_endmembers: int) -> list[str]:
        """Sensors with too few channels to tell so many endmembers apart, and what that means."""
        counts = [self.num_channels(sensor) for sensor in range(len(self._names))]
        few = [s for s in range(len(counts)) if not self.tells_materials(s, num_endmembers)]
        if not few:
            return []
        named = ", ".join(f"{self.sensor_names[s]} ({counts[s]})" for s in few)
        what = f"{num_endmembers} endmembers are more than these sensors have channels: {named}"
        if len(few) < len(counts):
            return [f"{what}; materials are found in the other sensors' pictures"]
        fitting = max([count for count in counts if count >= _FEWEST_CHANNELS], default=None)
        advice = "no sensor tells materials apart" if fitting is None else f"try --endmembers {fitting}"
        return [
            f"{what}; no sensor's pixels can be unmixed one by one, and materials may be mixed up: {advice}"
        ]
