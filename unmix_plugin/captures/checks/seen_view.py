"""A written view as the checks look at it: its camera, its picture, what was measured while it was written.

Notation: `H x W` pixels, `N` views, `P` points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.captures.poses.alignment import project
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.writing.view_files import ViewRecord


@dataclass(frozen=True)
class SeenView:
    """One view of a scene that is written."""

    record: ViewRecord
    camera: PosedCamera
    """With the lens of the picture."""
    picture: Path

    @property
    def name(self) -> str:
        """Of the view."""
        return self.record.name

    @property
    def position(self) -> Float64[np.ndarray, "3"]:
        """Of the camera."""
        return self.camera.camera_to_world[:, 3]

    @property
    def axis(self) -> Float64[np.ndarray, "3"]:
        """Unit vector along which the camera looks."""
        return -self.camera.camera_to_world[:, 2]

    @cached_property
    def luminance(self) -> Float32[np.ndarray, "H W"]:
        """Linear luminance of the picture, smoothed over 3 x 3 pixels; NaN where the view shows nothing."""
        from PIL import Image
        from scipy import ndimage

        with Image.open(self.picture) as picture:
            pixels = np.asarray(picture.convert("RGBA"))
        levels = np.arange(256) / 255.0
        linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
        light = linear[pixels[..., :3]] @ np.array([0.2126, 0.7152, 0.0722])
        smooth = ndimage.uniform_filter(light, 3)
        return np.where(pixels[..., 3] > 127, smooth, np.nan).astype(np.float32)

    def pixels_of(self, points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 2"]:
        """Where points are seen, x and y in pixels; NaN outside the picture or behind the camera."""
        found = project(self.camera, points)
        found[~self._inside(found)] = np.nan
        return found

    def has_before_it(self, points: Float64[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
        """Points nearer to the camera than the middle of all: those behind it are mostly hidden."""
        distances = np.linalg.norm(points - self.position, axis=1)
        return distances < np.linalg.norm(np.median(points, axis=0) - self.position)

    def brightness_at(self, pixels: Float64[np.ndarray, "P 2"]) -> Float64[np.ndarray, " P"]:
        """Luminance at pixels of `pixels_of`; NaN where it is."""
        found = np.full(len(pixels), np.nan)
        inside = np.isfinite(pixels).all(axis=1)
        columns, rows = np.floor(pixels[inside]).astype(int).T
        found[inside] = self.luminance[rows, columns]
        return found

    def _inside(self, pixels: Float64[np.ndarray, "P 2"]) -> Bool[np.ndarray, " P"]:
        assert self.camera.lens is not None
        width, height = self.camera.lens.width, self.camera.lens.height
        x, y = pixels.T
        return (x >= 0) & (x < width) & (y >= 0) & (y < height)  # false for NaN


def log_ratio(
    first: SeenView, second: SeenView, points: Float64[np.ndarray, "P 3"]
) -> Float64[np.ndarray, " P"]:
    """Logarithm of how much brighter points are in the second view than in the first; not finite where unseen."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(second.brightness_at(second.pixels_of(points))) - np.log(
            first.brightness_at(first.pixels_of(points))
        )


def angles_between(views: Sequence[SeenView]) -> Float64[np.ndarray, "N N"]:
    """Angles between optical axes, degrees."""
    axes = np.stack([view.axis for view in views])
    return np.degrees(np.arccos(np.clip(axes @ axes.T, -1.0, 1.0)))
