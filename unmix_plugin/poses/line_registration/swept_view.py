"""A view of a line camera as registration compares it: what it measured, and what a scene shows as its rows move.

Notation: `H` rows and `W` columns that are compared, `D` channels that are compared, `m` ways to move the rows, `n`
knots between which corrections are interpolated, `h` some of the rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.poses.knots import Knots, on_spline, spline_weights

Show = Callable[[RayBundle], Float[Tensor, "R D"]]
"""What a scene shows along rays, in the channels that are compared."""
_MATTER = 0.5
"""Opacity from which a pixel shows matter."""
_FEWEST_COLUMNS = 16


@dataclass(frozen=True)
class SweptView:
    """What one line camera measured, and the scene that should look like it.

    A step (w, m) turns a row's camera by the rotation vector w about itself, in the scene's axes, and moves it by m
    times `distance`.
    """

    rays: RayBundle
    """H * W of them, row after row, as the poses send them that steps start from."""
    wanted: Float[Tensor, "H W D"]
    """What was measured; the opacity is the last channel where it is known."""
    counts: Float[Tensor, "H W 1"]
    """Share of each pixel that counts, [0, 1]."""
    heights: Float[Tensor, " H"]
    """y of the rows in the image, pixels."""
    rows: int
    """Of the image."""
    distance: float
    """From the camera to the scene's middle, model space."""
    pixel: float
    """Angle of a pixel, radians."""
    show: Show
    has_opacity: bool

    @property
    def num_knots(self) -> int:
        """n."""
        return Knots((self.rows,)).counts[0]

    def places(self) -> tuple[Int[Tensor, " H"], Float64[Tensor, "H 4"]]:
        """Of each row the first of the four knots that tell of it, and their weights."""
        place = self.heights.double() / self.rows * (self.num_knots - 1)
        return spline_weights(place, torch.full_like(self.heights, self.num_knots, dtype=torch.int64))

    def at_rows(self, steps: Float64[Tensor, "n 6"]) -> Float64[Tensor, "H 6"]:
        """Steps at knots, interpolated."""
        return on_spline(steps, *self.places())

    def shown(self, steps: Float64[Tensor, "m H 6"], rows: slice) -> Float[Tensor, "m h W D"]:
        """What some rows show after each of some ways to move all of them."""
        width = self.wanted.shape[1]
        own = self.rays[slice(rows.start * width, rows.stop * width)]
        rays = RayBundle.join([self._moved(own, step[rows].float(), width) for step in steps])
        return self.show(rays).view(len(steps), -1, width, self.wanted.shape[2])

    def residuals(self, steps: Float64[Tensor, "m H 6"], rows: slice) -> Float[Tensor, "m h W D"]:
        """Shown less measured."""
        return (self.shown(steps, rows) - self.wanted[rows]) * self.counts[rows]

    def row_errors(self, steps: Float64[Tensor, "n 6"]) -> Float[Tensor, " H"]:
        """Mean squared error of the pixels around each row that show matter, here or there; 0 where none do."""
        shown = self.shown(self.at_rows(steps)[None], slice(0, len(self.heights)))[0]
        squares = ((shown - self.wanted) * self.counts).square().mean(dim=-1)
        matter = torch.ones_like(squares)
        if self.has_opacity:
            matter = (torch.maximum(shown[..., -1], self.wanted[..., -1]) > _MATTER).float()
        matter = matter * self.counts[..., 0]
        sums = torch.stack([(squares * matter).sum(dim=1), matter.sum(dim=1)])
        total, count = torch.nn.functional.avg_pool1d(sums, 5, 1, 2, count_include_pad=False)
        return torch.where(count > 0, total / count.clamp(min=1e-6), 0.0)

    @property
    def shows_matter(self) -> slice:
        """From the first to the last row that shows matter; empty where none does."""
        if not self.has_opacity:
            return slice(0, len(self.heights))
        rows = (self.wanted[..., -1] > _MATTER).any(dim=1).nonzero()[:, 0].tolist()
        return slice(rows[0], rows[-1] + 1) if rows else slice(0, 0)

    def moved(self, camera: Cameras, steps: Float64[Tensor, "n 6"]) -> Cameras:
        """The camera whose view this is, after steps: a key pose a row."""
        rows = self.at_rows(steps).float().to(camera.camera_to_world)
        heights = self.heights.to(rows)
        poses = camera.poses_at(torch.zeros(len(rows), dtype=torch.int64, device=rows.device), heights)
        turned = rotation_matrix(rows[:, :3]) @ poses[:, :, :3]
        places = poses[:, :, 3] + self.distance * rows[:, 3:]
        keys = KeyPoses(torch.cat([turned, places[:, :, None]], dim=-1), heights, (len(rows),))
        return replace(camera, key_poses=keys)

    def _moved(self, rays: RayBundle, steps: Float[Tensor, "h 6"], width: int) -> RayBundle:
        assert rays.axes is not None
        turns = rotation_matrix(steps[:, :3]).repeat_interleave(width, dim=0).to(rays.origins)
        moves = (self.distance * steps[:, 3:]).repeat_interleave(width, dim=0).to(rays.origins)
        directions, axes = ((turns @ x[:, :, None])[:, :, 0] for x in (rays.directions, rays.axes))
        return replace(rays, origins=rays.origins + moves, directions=directions, axes=axes)


def columns_compared(width: int, rows: int, most_pixels: int) -> Int[Tensor, " W"]:
    """Columns of an image, evenly spread, of which at most so many pixels are compared; a few at least."""
    count = min(width, max(_FEWEST_COLUMNS, most_pixels // rows))
    return ((torch.arange(count) + 0.5) * width / count).long()


def rays_through(camera: Cameras, index: int, columns: Int[Tensor, " W"]) -> RayBundle:
    """Rays through the middles of some columns' pixels, row after row."""
    rows = camera.size(index)[1]
    y, x = torch.meshgrid(torch.arange(rows) + 0.5, columns + 0.5, indexing="ij")
    coords = torch.stack([x, y], dim=-1).view(-1, 2).to(camera.camera_to_world)
    views = torch.full((len(coords),), index, dtype=torch.int64, device=coords.device)
    return camera.generate_rays(views, coords)
