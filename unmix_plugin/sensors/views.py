"""What sensors see of spectra: channels of a rig's sensors, bands that count less, and gains of views.

A sensor None is a scene's only, ordinary camera, which sees spectra as they are. Where some bands are much noisier than
others, errors of spectra are weighted in the loss; where spectra are compared by angle, as in unmixing, they are
multiplied by the roots of the weights first, so that squared distances carry the weights. Where exposure and white
balance of the views differ and nobody wrote them down, each has a gain that is smooth over the bands: exp of a
polynomial of second degree in the wavelength. What all views have in common is the scene's brightness, so the mean over
views is taken out, and a new view has gain 1.

Notation: `B` bands of the scene, `b` channels of a sensor, `K` endmembers, `R` pixels or rays, `V` training views, `T`
terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, SupportsInt

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError
from unmix_plugin.sensors.batches import MeasuredPixels
from unmix_plugin.spectral.bands import Bands
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
        for index, values in enumerate(sensors):
            sensor = SceneSensor.from_json(values, len(rgb_weights))
            matrix = torch.from_numpy(sensor.matrix).float()
            false_colours = torch.from_numpy(sensor.false_colours).float()
            colours = rgb_weights if sensor.sees_all_bands else false_colours
            self.register_buffer(f"matrix_{index}", matrix, persistent=False)
            self.register_buffer(f"colours_{index}", colours.clone(), persistent=False)
        self.register_buffer("plain_colours", rgb_weights.clone(), persistent=False)

    def __bool__(self) -> bool:
        return bool(self.sensor_names)

    def matrix(self, sensor: SupportsInt) -> Float[Tensor, "b B"]:
        """Operator of a sensor."""
        return self.get_buffer(f"matrix_{int(sensor)}")

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
        counts = [self.num_channels(sensor) for sensor in range(len(self.sensor_names))]
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

    def pixels(self, measured: MeasuredPixels) -> MeasuredPixels:
        """Pixels with scaled spectra."""
        return replace(measured, spectra=self.scaled(measured.spectra, measured.sensor))


_NUM_TERMS = 3


def smooth_terms(wavelengths_nm: Float[Tensor, "B"]) -> Float[Tensor, "T B"]:
    """Legendre polynomials of degrees 0 to 2 over the bands' range."""
    low, high = wavelengths_nm.min(), wavelengths_nm.max()
    x = 2 * (wavelengths_nm - low) / (high - low).clamp(min=1e-6) - 1
    return torch.stack([torch.ones_like(x), x, (3 * x * x - 1) / 2])


class ViewGains(nn.Module):
    """A smooth gain for each training view; 1 at first."""

    terms: Tensor

    def __init__(self, num_views: int, wavelengths_nm: Float[Tensor, "B"]) -> None:
        super().__init__()
        self.log_gains = nn.Parameter(torch.zeros(num_views, _NUM_TERMS))
        self.register_buffer("terms", smooth_terms(wavelengths_nm), persistent=False)

    def forward(self, views: Int[Tensor, "R"], terms: Float[Tensor, "T b"]) -> Float[Tensor, "R b"]:
        """Gains of the views that rays are of.

        Args:
            terms: The buffer of this name, as the rays' sensor sees it.
        """
        relative = self.log_gains - self.log_gains.mean(dim=0)
        return (relative.index_select(0, views) @ terms).exp()
