"""What sensors see of spectra: channels of a rig's sensors, bands that count less, and gains of views; and what they
measured: the pixels of a training batch.

A sensor None is a scene's only, ordinary camera, which sees spectra as they are. Where some bands are much noisier than
others, errors of spectra are weighted in the loss; where spectra are compared by angle, as in unmixing, they are
multiplied by the roots of the weights first, so that squared distances carry the weights. Where exposure and white
balance of the views differ and nobody wrote them down, each has a gain that is smooth over the bands: exp of a
polynomial of second degree in the wavelength. What all views have in common is the scene's brightness, so the mean over
views is taken out, and a new view has gain 1.

The pixels of one sensor are together in a batch, one sensor after the other; the rays of a pixel follow each other. The
engine's batch of a rig has, beside what every batch has, `sensors`, `sensor_pixels` and `sensor_rays` (G each, on the
CPU): which sensors some pixels are of, how many of each, and how many rays each such pixel has. `spectra` is 0 beyond a
sensor's channels.

Notation: `B` bands of the scene, `b` channels of a sensor, `G` sensors of a batch, `K` endmembers, `R` pixels or rays,
`V` training views, `T` terms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, SupportsInt

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import SceneSensor

_COLUMNS = ("alpha", "pixels", "alpha_confidence", "surfaces")


@dataclass(frozen=True)
class MeasuredPixels:
    """Pixels of one sensor."""

    sensor: int | None
    """Which of the scene's; None where it has one ordinary camera."""
    num_rays: int
    """Through all of them."""
    spectra: Float[Tensor, "R b"]
    alpha: Float[Tensor, "R"]
    pixels: Int[Tensor, "R"]
    """Number of each."""
    alpha_confidence: Float[Tensor, "R"] | None = None
    """Confidence in alpha, 0 or 1; None: 1 everywhere."""
    surfaces: Float[Tensor, "R 3"] | None = None
    """Places that the pixels are known to show, model space, NaN where unknown; None where none are known."""

    def __len__(self) -> int:
        return len(self.spectra)

    def surfaces_of_rays(self) -> Float[Tensor, "rays 3"] | None:
        """`surfaces` of the pixel of each ray."""
        if self.surfaces is None:
            return None
        return self.surfaces.repeat_interleave(self.num_rays // len(self), dim=0)


def to_batch(parts: Sequence[MeasuredPixels]) -> dict[str, Tensor]:
    """The engine's batch of some pixels; those of a rig have numbers of sensors."""
    most = max(part.spectra.shape[1] for part in parts)
    batch: dict[str, Tensor] = {}
    for name in ("spectra", *_COLUMNS):
        columns = [getattr(part, name) for part in parts]
        if name == "spectra" and len(parts) > 1:
            columns = [torch.nn.functional.pad(each, (0, most - each.shape[1])) for each in columns]
        if columns[0] is not None:
            batch[name] = columns[0] if len(parts) == 1 else torch.cat(columns)
    sensors = [part.sensor for part in parts if part.sensor is not None]
    if sensors:
        batch["sensors"] = torch.tensor(sensors)
        batch["sensor_pixels"] = torch.tensor([len(part) for part in parts])
        batch["sensor_rays"] = torch.tensor([part.num_rays // len(part) for part in parts])
    return batch


def from_batch(
    batch: dict[str, Tensor], num_rays: int, num_channels: Callable[[int], int]
) -> list[MeasuredPixels]:
    """The pixels of a batch, sensor by sensor.

    Args:
        batch: As `to_batch` makes it.
        num_rays: Of the batch.
        num_channels: Of a sensor.
    """
    columns = {name: batch[name] for name in _COLUMNS if name in batch}
    if "sensors" not in batch:
        return [MeasuredPixels(None, num_rays, batch["spectra"], **columns)]
    groups = [batch[name].tolist() for name in ("sensors", "sensor_pixels", "sensor_rays")]
    parts, start = [], 0
    for sensor, pixels, rays in zip(*groups, strict=True):
        rows = slice(start, start + pixels)
        own = {name: values[rows] for name, values in columns.items()}
        spectra = batch["spectra"][rows, : num_channels(sensor)]
        parts.append(MeasuredPixels(sensor, pixels * rays, spectra, **own))
        start = rows.stop
    return parts


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
