"""From pixels of any size to rays: as many through the pixels of a coarse sensor as through those of a sharp one.

A coarse pixel is the mean of many fine ones, but one ray through each of those would leave a batch with a few coarse
pixels: too few to learn from, and all their rays end in the same cells, so that the other cells seem to be seen by no
view.

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
        if self._scene.is_unbounded:  # cameras may be in the middle of what they see
            distances = distances.clamp(min=float(self._scene.scene_box.size.max()) / 2)
        edges = distances / self._cameras.focal_px.mean(dim=-1)
        sensors = torch.tensor([self._scene.frames[view].sensor for view in self._scene.train_indices])
        return {sensor: float(edges[sensors == sensor].median()) for sensor in set(sensors.tolist())}

    def shares(self, valid: Mapping[int, float]) -> dict[int, float]:
        """Of the pixels of a batch, by sensor: in proportion to the area that the pixels of its views cover.

        Drawn evenly, the pixels of a sharp sensor, which are many, would leave hardly any of a coarse one.

        Args:
            valid: Of all valid pixels, the share of each sensor.
        """
        areas = {sensor: share * self.pixel_sizes[sensor] ** 2 for sensor, share in valid.items()}
        return {sensor: area / sum(areas.values()) for sensor, area in areas.items()}

    def through(self, pixels: DrawnPixels, subpixels: int, generator: torch.Generator) -> RayBundle:
        """Rays scattered over pixels of one sensor, those of a pixel one after the other."""
        offsets = _scattered_offsets(len(pixels.cameras), subpixels, generator).to(pixels.corners.device)
        points = (pixels.corners[:, None] + offsets).flatten(0, 1)
        return self._device_cameras.generate_rays(pixels.cameras.repeat_interleave(subpixels**2), points)


def _scattered_offsets(num_pixels: int, subpixels: int, generator: torch.Generator) -> Float[Tensor, "R P 2"]:
    """One random point in each cell of a subpixels x subpixels grid on every pixel, (x, y) in [0, 1)."""
    cells = torch.arange(subpixels)
    grid = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1).reshape(1, -1, 2)
    return (grid + torch.rand(num_pixels, subpixels**2, 2, generator=generator)) / subpixels
