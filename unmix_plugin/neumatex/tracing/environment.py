"""Light from infinitely far away: a latitude-longitude picture, looked up and drawn from.

Directions are unit vectors in the scene's world, +z up, or in axes that turn with the camera. The picture is Blender's
equirectangular one: u = 0.5 - atan2(y, x) / 2 pi from left to right, v = acos(z) / pi from top to bottom, pixel centres
at half integers.

Notation: `H x W` pixels, `C` colours, `N` directions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from unmix_plugin.light.lamp import LAMP_FRAMES, LampFrame, moving_axes


@dataclass(frozen=True)
class MovingFrame:
    """Axes that turn with the camera, in which light stands still: that of an object on a turntable, or of a lamp that
    the camera carries."""

    kind: LampFrame
    """Whether it only turns about the axis with the camera, or also goes up and down with it."""
    middle: tuple[float, float, float]
    """A point on the axis that cameras look at."""
    axis: tuple[float, float, float]
    """Unit vector upwards along the axis."""

    def axes(self, eyes: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
        """Rows x, y, z of a map that is seen from `eyes`: towards the camera, to its right, and up."""
        right, up, back = moving_axes(
            eyes, eyes.new_tensor(self.middle), eyes.new_tensor(self.axis), self.kind
        )
        return torch.stack([back, right, up], dim=1)

    def numbers(self) -> tuple[float, ...]:
        """Seven numbers: 0 for a turntable's frame or 1 for the camera's, then both triples."""
        return (float(LAMP_FRAMES.index(self.kind)), *self.middle, *self.axis)

    @staticmethod
    def of_numbers(numbers: Sequence[float]) -> MovingFrame:
        """The frame of seven numbers; the axis may have any length but 0."""
        middle, axis = ((numbers[i], numbers[i + 1], numbers[i + 2]) for i in (1, 4))
        x, y, z = (part / math.hypot(*axis) for part in axis)
        return MovingFrame(LAMP_FRAMES[int(numbers[0])], middle, (x, y, z))


@dataclass(frozen=True)
class Environment:
    """Radiance of every direction, bilinear between pixel centres."""

    image: Float[Tensor, "H W C"]
    """Linear radiance, at least 0, before the exposure."""
    rotation_deg: float = 0.0
    """Turns the light about +z, counter-clockwise seen from above."""
    exposure_stops: float = 0.0
    """Radiance is the picture's times 2 to this power."""
    moves: MovingFrame | None = None
    """Whose axes directions are in; None: those of the world."""

    def seen_from(self, eye: Float[Tensor, "3"]) -> Environment:
        """The light that stands in the world as it does for a camera at `eye`."""
        if self.moves is None:
            return self
        height, width, colours = self.image.shape
        directions = (
            directions_of_pixels(height, width).flatten(0, 1).to(self.image) @ self.moves.axes(eye[None])[0].T
        )
        return Environment(self.radiance(directions).view(height, width, colours))

    @property
    def num_colours(self) -> int:
        """C."""
        return self.image.shape[2]

    def radiance(self, directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"]:
        """Radiance that comes from directions; differentiable by the picture."""
        height, width, colours = self.image.shape
        u, v = self._picture_coordinates(directions)
        x, y = u * width - 0.5, (v * height - 0.5).clamp(0.0, height - 1.0)
        left, top = x.floor(), y.floor()
        right_share, low_share = (x - left)[:, None], (y - top)[:, None]
        column, row = left.long() % width, top.long()
        next_column, next_row = (column + 1) % width, (row + 1).clamp(max=height - 1)
        pixels = self._scaled_image.reshape(-1, colours)
        upper, lower = (
            torch.lerp(pixels[at * width + column], pixels[at * width + next_column], right_share)
            for at in (row, next_row)
        )
        return torch.lerp(upper, lower, low_share)

    def sample(self, uniforms: Float[Tensor, "N 2"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
        """Directions drawn about as the radiance is distributed, and their density in 1/sr.

        A pixel is drawn by its mean radiance and solid angle; within it, directions are uniform in solid angle. An
        alias table would be as fast, but scatter numbers that are evenly spread: with 160 samples per point the noise
        of pictures would be twice as large. Uniforms are in [0, 1); float64 ones place directions more finely in a
        pixel.
        """
        height, width = self.image.shape[:2]
        rows, columns, down, across = self._pixels.draw(uniforms)
        azimuth = 2 * math.pi * (0.5 - (columns + across) / width) + math.radians(self.rotation_deg)
        top, bottom = (torch.cos(math.pi * edge.double() / height) for edge in (rows, rows + 1))
        z = top + (bottom - top) * down
        flat = (1 - z * z).clamp(min=0.0).sqrt()
        directions = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=-1)
        return directions.float(), self._densities[rows, columns].float()

    def density(self, directions: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Density of `sample`, 1/sr; its integral over the sphere is 1."""
        height, width = self.image.shape[:2]
        u, v = self._picture_coordinates(directions)
        column = (u * width).long().clamp(0, width - 1)
        row = (v * height).long().clamp(0, height - 1)
        return self._densities.reshape(-1)[row * width + column].float()

    def mean_radiance(self) -> Float[Tensor, " C"]:
        """Mean radiance over the sphere, a colour."""
        power = (self._scaled_image.double() * self._solid_angles[:, None, None]).sum(dim=(0, 1))
        return power.float() / (4 * math.pi)

    def _picture_coordinates(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """u and v in [0, 1]."""
        x, y, z = directions.unbind(dim=-1)
        u = 0.5 - (torch.atan2(y, x) - math.radians(self.rotation_deg)) / (2 * math.pi)
        return u - u.floor(), torch.atan2(torch.hypot(x, y), z) / math.pi  # at the poles, z says little

    @cached_property
    def _scaled_image(self) -> Float[Tensor, "H W C"]:
        return self.image.float() * 2.0**self.exposure_stops

    @cached_property
    def _solid_angles(self) -> Float64[Tensor, " H"]:
        return solid_angles(*self.image.shape[:2]).to(self.image.device)

    @cached_property
    def _weights(self) -> Float64[Tensor, "H W"]:
        """Power that comes from each pixel: the mean of its bilinear radiance times its solid angle."""
        grey = self.image.detach().double().mean(dim=-1)
        rows = torch.cat([grey[:1], grey, grey[-1:]])
        grey = 0.125 * rows[:-2] + 0.75 * rows[1:-1] + 0.125 * rows[2:]
        grey = 0.125 * grey.roll(1, dims=1) + 0.75 * grey + 0.125 * grey.roll(-1, dims=1)
        weights = grey * self._solid_angles[:, None]
        # A black environment is drawn from uniformly: nothing comes from it, but densities stay numbers.
        return weights if bool(weights.sum() > 0) else self._solid_angles[:, None].expand_as(grey)

    @cached_property
    def _pixels(self) -> PictureInversion:
        return PictureInversion(self._weights)

    @cached_property
    def _densities(self) -> Float64[Tensor, "H W"]:
        return self._weights / self._weights.sum() / self._solid_angles[:, None]


def solid_angles(height: int, width: int) -> Float64[Tensor, " H"]:
    """Of a pixel of each row of an environment's picture, sr."""
    edges = torch.arange(height + 1, dtype=torch.float64) * math.pi / height
    return (2 * math.pi / width) * (edges[:-1].cos() - edges[1:].cos())


def directions_of_pixels(height: int, width: int) -> Float[Tensor, "H W 3"]:
    """Directions that the pixel centres of an environment's picture stand for."""
    v, u = torch.meshgrid(
        (torch.arange(height, dtype=torch.float64) + 0.5) / height,
        (torch.arange(width, dtype=torch.float64) + 0.5) / width,
        indexing="ij",
    )
    polar, azimuth = math.pi * v, 2 * math.pi * (0.5 - u)
    flat = polar.sin()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), polar.cos()], dim=-1).float()


class PictureInversion:
    """Pixels drawn by their weights, by inversion of cumulative shares."""

    def __init__(self, weights: Float64[Tensor, "H W"]) -> None:
        """Weights are at least 0, not all of them 0."""
        self._rows, self._columns = _cumulative(weights.sum(dim=1)), _cumulative(weights)
        indices = torch.arange(len(weights), dtype=torch.float64, device=weights.device)
        # Share up to and with each pixel of its row, plus the row's index: one increasing list.
        self._ends = (self._columns[:, 1:] + indices[:, None]).reshape(-1)

    def draw(
        self, uniforms: Float[Tensor, "N 2"]
    ) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Float64[Tensor, " N"], Float64[Tensor, " N"]]:
        """Rows and columns, and how far down and across in the pixel, in [0, 1], by numbers in [0, 1)."""
        for_row, for_column = uniforms.double().T.contiguous()
        rows, columns = self._rows, self._columns
        width = columns.shape[1] - 1
        row = torch.searchsorted(rows, for_row, right=True).clamp(1, len(rows) - 1) - 1
        column = torch.searchsorted(self._ends, for_column + row, right=True) - row * width
        column = column.clamp(0, width - 1)
        down = _within(for_row, rows[row], rows[row + 1])
        return row, column, down, _within(for_column, columns[row, column], columns[row, column + 1])


def _cumulative(weights: Float64[Tensor, "*rows n"]) -> Float64[Tensor, "*rows n+1"]:
    """Shares before each item; even ones where all weights are 0."""
    weights = torch.where(weights.sum(dim=-1, keepdim=True) > 0, weights, 1.0)
    sums = weights.cumsum(dim=-1)
    return torch.cat([torch.zeros_like(sums[..., :1]), sums / sums[..., -1:]], dim=-1)


def _within(value: Tensor, low: Tensor, high: Tensor) -> Float64[Tensor, " N"]:
    return ((value - low) / (high - low).clamp(min=1e-300)).clamp(0.0, 1.0)
