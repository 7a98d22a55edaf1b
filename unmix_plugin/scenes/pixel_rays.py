"""From pixels of any size to rays: a coarse sensor's pixel is a mean over the area of several fine ones.

Notation: `R` pixels, `P` rays through each.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.scenes.pixel_table import DrawnPixels
from unmix_plugin.scenes.scene import Scene

MOST_SENSOR_SUBPIXELS = 4
"""Along an edge of a coarse sensor's pixel, in multiples of the finest sensor's."""


class PixelRays:
    """Rays through pixels of a scene's training views."""

    def __init__(self, scene: Scene, device: torch.device) -> None:
        self._scene = scene
        self._cameras = scene.cameras[list(scene.train_indices)]
        self._device_cameras: Cameras = self._cameras.to(device)

    @cached_property
    def pixel_sizes(self) -> dict[int, float]:
        """Of each sensor, the edge of a pixel where it looks at the middle of the scene box, median over its views."""
        centre = self._scene.scene_box.aabb.mean(dim=0)
        distances = (self._cameras.camera_to_world[:, :, 3] - centre).norm(dim=-1)
        if self._scene.is_unbounded:  # cameras may stand in the middle of what they see
            distances = distances.clamp(min=float(self._scene.scene_box.size.max()) / 2)
        edges = distances / self._cameras.focal_px.mean(dim=-1)
        sensors = torch.tensor([self._scene.frames[view].sensor for view in self._scene.train_indices])
        return {sensor: float(edges[sensors == sensor].median()) for sensor in set(sensors.tolist())}

    @cached_property
    def factors(self) -> dict[int, int]:
        """Of each sensor, by how many times more rays its pixels are wide: as many as fine pixels lie along an edge."""
        finest = min(self.pixel_sizes.values())
        return {
            sensor: min(max(1, round(size / finest)), MOST_SENSOR_SUBPIXELS)
            for sensor, size in self.pixel_sizes.items()
        }

    def rays_a_pixel(self, subpixels: int, shares: Mapping[int, float]) -> float | int:
        """In the mean over the pixels of all sensors; `subpixels` along an edge of the finest."""
        if not self._scene.is_rig:
            return subpixels**2
        return sum(share * (subpixels * self.factors[sensor]) ** 2 for sensor, share in shares.items())

    def through(self, pixels: DrawnPixels, subpixels: int, generator: torch.Generator) -> RayBundle:
        """Rays scattered over pixels of one sensor, those of a pixel one after the other."""
        edge = subpixels * self.factors[pixels.sensor]
        offsets = _scattered_offsets(len(pixels.cameras), edge, generator).to(pixels.corners.device)
        points = (pixels.corners[:, None] + offsets).flatten(0, 1)
        return self._device_cameras.generate_rays(pixels.cameras.repeat_interleave(edge**2), points)


def _scattered_offsets(num_pixels: int, subpixels: int, generator: torch.Generator) -> Float[Tensor, "R P 2"]:
    """One random point in each cell of a subpixels x subpixels grid on every pixel, (x, y) in [0, 1)."""
    cells = torch.arange(subpixels)
    grid = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1).reshape(1, -1, 2)
    return (grid + torch.rand(num_pixels, subpixels**2, 2, generator=generator)) / subpixels
