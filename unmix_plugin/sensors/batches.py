"""Training batches of scenes with several sensors: the pixels of one sensor are together, one sensor after the other.

Such a batch has, beside what every batch has, `sensors`, `sensor_pixels` and `sensor_rays` (G each, on the CPU): which
sensors some pixels are of, how many of each, and how many rays each such pixel has. `spectra` (R, b) is 0 beyond the
channels of a pixel's sensor.

Notation: `R` pixels, `P` rays, `b` channels of a sensor, `G` sensors of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from unmix_plugin.engine.geometry.space import RayBundle

_OF_BATCH = ("sensors", "sensor_pixels", "sensor_rays")


@dataclass(frozen=True)
class SensorPart:
    """The pixels of one sensor, or of a scene's only one."""

    sensor: int | None
    """Which of the scene's; None where it has one ordinary camera."""
    share: float
    """Of the batch's rays."""
    outputs: dict[str, Tensor]
    """Rendered, one row a ray."""
    batch: dict[str, Tensor]
    """Measured, one row a pixel; spectra (R, b)."""


def join_parts(
    parts: Sequence[tuple[int, RayBundle, dict[str, Tensor]]],
) -> tuple[RayBundle, dict[str, Tensor]]:
    """One batch of sensors, their rays and what their pixels measured; at least one."""
    bundles, batches = [bundle for _, bundle, _ in parts], [batch for _, _, batch in parts]
    most = max(batch["spectra"].shape[1] for batch in batches)
    counts = [len(batch["spectra"]) for batch in batches]
    joined = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0] if name != "spectra"}
    joined["spectra"] = torch.cat(
        [torch.nn.functional.pad(b["spectra"], (0, most - b["spectra"].shape[1])) for b in batches]
    )
    joined["sensors"] = torch.tensor([sensor for sensor, _, _ in parts])
    joined["sensor_pixels"] = torch.tensor(counts)
    joined["sensor_rays"] = torch.tensor(
        [len(bundle) // count for bundle, count in zip(bundles, counts, strict=True)]
    )
    columns: list[Any] = []
    for name in RayBundle.__dataclass_fields__:
        column = [getattr(bundle, name) for bundle in bundles]
        columns.append(None if any(x is None for x in column) else torch.cat(column))
    rays = RayBundle(*columns)
    return rays, joined


def split_parts(
    outputs: dict[str, Tensor], batch: dict[str, Tensor], num_channels: Callable[[int], int]
) -> list[SensorPart]:
    """What belongs to each sensor; the whole, as it is, for a batch of one ordinary camera.

    Args:
        outputs: Of the model; those without a row for each ray go to no part of several.
        batch: As `join_parts` made it, or without sensors.
        num_channels: Of a sensor.
    """
    if "sensors" not in batch:
        return [SensorPart(None, 1.0, outputs, batch)]
    groups = [batch[name].tolist() for name in _OF_BATCH]
    num_rays = sum(pixels * rays for _, pixels, rays in zip(*groups, strict=True))
    of_rays = {name: x for name, x in outputs.items() if x.ndim > 0 and len(x) == num_rays}
    of_pixels = {name: x for name, x in batch.items() if name not in _OF_BATCH}
    parts, first_pixel, first_ray = [], 0, 0
    for sensor, pixels, rays in zip(*groups, strict=True):
        pixel_rows = slice(first_pixel, first_pixel + pixels)
        ray_rows = slice(first_ray, first_ray + pixels * rays)
        own = {name: x[pixel_rows] for name, x in of_pixels.items()}
        own["spectra"] = own["spectra"][:, : num_channels(sensor)]
        seen = {name: x[ray_rows] for name, x in of_rays.items()}
        parts.append(SensorPart(sensor, pixels * rays / num_rays, seen, own))
        first_pixel, first_ray = pixel_rows.stop, ray_rows.stop
    return parts


def mean_over_parts(
    parts: Sequence[SensorPart], losses: Callable[[SensorPart], dict[str, Tensor]]
) -> dict[str, Tensor]:
    """Mean of each loss over parts, weighted with their shares; a part without some loss adds 0 to it."""
    if len(parts) == 1:
        return losses(parts[0])
    totals: dict[str, Tensor] = {}
    for part in parts:
        for name, loss in losses(part).items():
            totals[name] = totals[name] + part.share * loss if name in totals else part.share * loss
    return totals
