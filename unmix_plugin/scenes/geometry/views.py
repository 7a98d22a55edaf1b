"""Views that show the same bands, thinned out to few pixels and compared with each other along rays.

A point of the scene looks alike in all views that see it. So points along the rays of some pixels are projected into
neighbouring views, and the best agreement along each ray counts.

Notation: `N` views, `H x W` pixels of a view, `h x w` of it thinned out, `B` bands, `F` features of a pixel, `P` pixels
of one view, `D` points along a ray. Poses are camera to world with OpenGL axes, float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.sampling import evenly_spaced

Image = Float[Tensor, "h w F"]
"""Features of a view thinned out, NaN in its gaps."""
Differences = Float[Tensor, "P D"]
"""Between pixels and what another view shows of points along their rays; inf where it does not see them."""
_MOST_BANDS = 32
"""Of what is compared."""
_MOST_POOLED = 4
"""Pixels along an edge that are averaged, if there are so many; of more, every second or third is left out."""
NUM_AGREEING = 3
"""Of the neighbours of a view, how many must agree with it: the one that agrees least may be hidden by something."""
LONGEST_SIDE_PX = 128
"""Of what is compared: larger views are thinned out."""
_NUM_FEATURES, _PIXELS_OF_FEATURES = 4, 5000
_SMALLEST_TURN_DEG = 3.0
"""Neighbours are views that are turned against each other by at least this, if there are any."""


@dataclass(frozen=True)
class Views:
    """Views of one sensor."""

    cameras: Cameras
    read: Callable[[int, tuple[slice, ...]], Float32[np.ndarray, "H W B"]]
    """From a view, and the rows, columns and bands wanted, to its picture."""
    valid: Callable[[int], Bool[np.ndarray, "H W"]] | None = None
    """From a view to its pixels that count: the others show what is no part of the scene. None where all count."""


def commonest(sensors: list[int]) -> list[int]:
    """Which views to compare, given the sensor of each: those of the sensor with most, since bands must agree."""
    most = max(sensors, key=sensors.count)
    return [row for row, sensor in enumerate(sensors) if sensor == most]


class ThinnedViews:
    """Views in few pixels, each the mean of some that are read."""

    def __init__(
        self, views: Views, longest_side_px: int = LONGEST_SIDE_PX, most_pooled: int = _MOST_POOLED
    ) -> None:
        """With at most so many pixels along the longer side, and `_MOST_BANDS`."""
        stride = -(-max(views.cameras.width, views.cameras.height) // longest_side_px)
        fine = max(1, stride // most_pooled)
        self._views, self._fine, self._pooled = views, fine, stride // fine
        self._band_step = -(-views.read(0, (slice(1), slice(1))).shape[2] // _MOST_BANDS)
        self.stride = fine * self._pooled
        """Pixels of the whole view from one pixel of the thinned-out one to the next."""
        self._first = fine * (self._pooled - 1) / 2
        """Where in the whole view the first lies, from the centre of its first pixel on."""

    def read(self, view: int) -> Float[Tensor, "h w B"]:
        """A view thinned out."""
        some = slice(None, None, self._fine)
        picture = self._views.read(view, (some, some, slice(None, None, self._band_step)))
        image = torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)
        return torch.nn.functional.avg_pool2d(image, self._pooled).permute(1, 2, 0)

    def valid_share(self, view: int) -> Float[Tensor, "h w"] | None:
        """Of what is averaged to each pixel, the share that counts; None where all does."""
        if self._views.valid is None:
            return None
        some = self._views.valid(view)[:: self._fine, :: self._fine].astype(np.float32)
        return torch.nn.functional.avg_pool2d(torch.from_numpy(some)[None], self._pooled)[0]

    def whole(self, coords: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2"]:
        """Coordinates in the whole view of those in the thinned-out one; pixel centres are at + 0.5 in both."""
        return (coords - 0.5) * self.stride + self._first + 0.5

    def cameras(self, image: Float[Tensor, "h w _"]) -> Cameras:
        """The same poses with lenses of views thinned out, such as `image`."""
        whole, (height, width) = self._views.cameras, image.shape[:2]
        center = (whole.center_px - 0.5 - self._first) / self.stride + 0.5
        return Cameras(
            whole.camera_to_world, whole.focal_px / self.stride, center, whole.distortion, width, height
        )


def look_up(
    cameras: Cameras, view: int, points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P 2"], Float[Tensor, " P"], Bool[Tensor, " P"]]:
    """Where points are in a view, pixels, their depths, and whether they lie within it and before its camera."""
    coords, depths = cameras.project(points, view)
    (x, y), (width, height) = coords.unbind(-1), cameras.size(view)
    return coords, depths, (depths > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)


def choose_neighbours(
    poses: Float64[np.ndarray, "N 3 4"], num_references: int, num_neighbours: int
) -> dict[int, list[int]]:
    """For some views the others that are turned least against them; the same under every convention of poses."""
    rotations, positions = poses[:, :, :3], poses[:, :, 3]
    cosines = (np.einsum("iab,jab->ij", rotations, rotations) - 1.0) / 2.0
    turns = np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0)))
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    ranks = turns + 0.1 * distances / max(float(distances.max()), 1e-30)
    ranks[turns < _SMALLEST_TURN_DEG] += 360.0
    np.fill_diagonal(ranks, np.inf)
    count = min(num_neighbours, len(poses) - 1)
    return {
        view: np.argsort(ranks[view])[:count].tolist() for view in evenly_spaced(len(poses), num_references)
    }


def view_features(views: list[Float[Tensor, "h w B"]], generator: torch.Generator) -> list[Image]:
    """Principal components of the spectra of all views, the first with a spread of 1, smoothed a little; gaps get wider
    by a pixel."""
    spectra = torch.cat([view.flatten(0, 1) for view in views])
    spectra = spectra[spectra.isfinite().all(dim=-1)]
    some = spectra[torch.randperm(len(spectra), generator=generator)[:_PIXELS_OF_FEATURES]]
    mean = some.mean(dim=0)
    _, spreads, axes = torch.linalg.svd(some - mean, full_matrices=False)
    axes = axes[:_NUM_FEATURES].T / (spreads[0] / len(some) ** 0.5).clamp(min=1e-12)
    images = [((view - mean) @ axes).permute(2, 0, 1) for view in views]
    smoothed = [torch.nn.functional.avg_pool2d(image, 3, 1, 1, count_include_pad=False) for image in images]
    return [image.permute(1, 2, 0).contiguous() for image in smoothed]


def view_differences(
    rays: RayBundle,
    distances: Float[Tensor, "*P D"],
    own: Float[Tensor, "P F"],
    image: Image,
    cameras: Cameras,
    view: int,
) -> Differences:
    """Between pixels and what another view shows of points along their rays; inf where that does not see them."""
    points = rays.origins[:, None] + rays.directions[:, None] * distances[..., None]
    coords, depths = cameras.project(points.flatten(0, 1), view)
    (x, y), size = coords.unbind(-1), torch.tensor([cameras.width, cameras.height])
    is_seen = (depths > 0.0) & (x > 0.5) & (x < size[0] - 0.5) & (y > 0.5) & (y < size[1] - 0.5)
    grid = (coords / size * 2.0 - 1.0).clamp(-2.0, 2.0)[None, :, None]
    sampled = torch.nn.functional.grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False)
    # Features first: a norm along a last axis of a few numbers takes ten times as long.
    shown = sampled[0, :, :, 0].view(own.shape[-1], len(own), -1)
    differences = (shown - own.T[:, :, None]).square_().sum(dim=0).sqrt_()
    return differences.masked_fill(~is_seen.reshape(differences.shape) | differences.isnan(), torch.inf)


def best_agreement(differences: list[Differences]) -> Differences:
    """Mean over those neighbours that agree best; inf where too few see a point."""
    return torch.stack(differences, dim=-1).sort(dim=-1).values[..., :NUM_AGREEING].mean(dim=-1)
