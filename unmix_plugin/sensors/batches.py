"""Training batches: what the pixels of each sensor measured, as values here and as the engine's dictionary between.

The pixels of one sensor are together, one sensor after the other; the rays of a pixel follow each other. The batch of a
rig has, beside what every batch has, `sensors`, `sensor_pixels` and `sensor_rays` (G each, on the CPU): which sensors
some pixels are of, how many of each, and how many rays each such pixel has. `spectra` is 0 beyond a sensor's channels.

Notation: `R` pixels, `b` channels of a sensor, `G` sensors of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

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

    def first(self, count: int) -> MeasuredPixels:
        """The first so many pixels."""
        columns = {name: getattr(self, name) for name in ("spectra", *_COLUMNS)}
        cut = {name: None if values is None else values[:count] for name, values in columns.items()}
        return replace(self, **cut)


def to_batch(parts: Sequence[MeasuredPixels]) -> dict[str, Tensor]:
    """The engine's batch of some pixels; those of a rig have numbers of sensors."""
    most = max(part.spectra.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.spectra, (0, most - part.spectra.shape[1])) for part in parts]
    batch = {"spectra": torch.cat(padded)}
    for name in _COLUMNS:
        columns = [getattr(part, name) for part in parts]
        if columns[0] is not None:
            batch[name] = torch.cat(columns)
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
