"""Some rays through the whole scene that stay the same while the camera moves: colour scales and principal axes are
taken from them, so that colours mean the same from everywhere.

Notation: `N` reference rays that end on something, `B` bands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.trained.trained_scene import TrainedScene

_NUM_CAMERAS = 6
_NUM_RAYS = 6000


@dataclass(frozen=True)
class Reference:
    """Coefficients of the reference rays."""

    coefficients: Coefficients
    """(N, ...)."""
    points: Float[Tensor, "N 3"]
    """Where the rays end, model space."""

    def spectra(self, materials: Materials) -> Float[Tensor, "N B"]:
        """What the rays show with the given materials, as if each ended fully on what it ended on."""
        return materials.spectra(self.coefficients) / self.coefficients.accumulation[:, None]

    def range_of(self, values: Float[Tensor, "N"]) -> tuple[float, float]:
        """From 0, or the 1st percentile of values that may be negative, to the 99th percentile."""
        return percentile_range(values, low_at_most=0.0)


def percentile_range(values: Float[Tensor, "N"], low_at_most: float = math.inf) -> tuple[float, float]:
    """From the 1st percentile, or `low_at_most` if that is less, to the 99th; never empty."""
    if len(values) == 0:
        return (0.0, 1.0)
    low, high = torch.quantile(values.float(), values.new_tensor([0.01, 0.99]).float()).tolist()
    low = min(low, low_at_most)
    return (low, high if high > low + 1e-6 else low + 1.0)


@torch.no_grad()
def render_reference(scene: TrainedScene, cameras: Cameras) -> Reference:
    """Reference rays through some of the cameras, spread over all."""
    step = max(1, len(cameras) // _NUM_CAMERAS)
    chosen = list(range(0, len(cameras), step))[:_NUM_CAMERAS]
    cameras = cameras.one_size()
    aspect = cameras.width / cameras.height
    height = max(1, min(cameras.height, int((_NUM_RAYS / len(chosen) / aspect) ** 0.5)))
    parts, points = [], []
    for index in chosen:
        camera = cameras[index].resized(max(1, round(aspect * height)), height)
        seen = scene.look(camera, subpixels=1).coefficients.flatten()
        rays = camera.to(scene.device).image_rays(0)
        ends = rays.origins + seen.ray_distance[:, None] * rays.directions
        is_seen = seen.is_occupied
        parts.append(seen.map(lambda packed, chosen=is_seen: packed[chosen]))
        points.append(ends[is_seen])
    return Reference(Coefficients.concatenate(parts), torch.cat(points))
