"""Poses of line cameras: a function of the row, interpolated between key poses.

A line camera takes one row of its image after the other while it moves, so each row has a pose of its own. Between key
poses the rotation turns about one axis at an even rate (slerp) and the position moves along a straight line; beyond the
first and the last key pose, by half a row at most, both go on.

Notation: `N` cameras, `M` key poses of all cameras, `R` rays; `y` is a height in the image in pixels, so row r is taken
at y = r + 0.5. A frame camera has one key pose, which holds for all rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from unmix_plugin.engine.geometry.rotations import rotation_matrix, rotation_vector


@dataclass(frozen=True)
class KeyPoses:
    """Key poses of some cameras, those of each camera after the other."""

    poses: Float[Tensor, "M 3 4"]
    """Camera to world, OpenGL axes."""
    heights: Float[Tensor, " M"]
    """y at which each holds; they increase within a camera."""
    counts: tuple[int, ...]
    """Key poses of each camera: 1 for a frame camera, more for a line camera."""

    @staticmethod
    def join(parts: list[KeyPoses]) -> KeyPoses:
        """Those of several groups of cameras, at least one group."""
        return KeyPoses(
            torch.cat([part.poses for part in parts]),
            torch.cat([part.heights for part in parts]),
            tuple(count for part in parts for count in part.counts),
        )

    @cached_property
    def is_line(self) -> Bool[Tensor, " N"]:
        """Which cameras are line cameras."""
        return torch.tensor([count > 1 for count in self.counts], device=self.poses.device)

    def of(self, camera: int) -> KeyPoses:
        """Those of one camera."""
        first = sum(self.counts[:camera])
        rows = slice(first, first + self.counts[camera])
        return KeyPoses(self.poses[rows], self.heights[rows], (self.counts[camera],))

    def to(self, device: torch.device | str) -> KeyPoses:
        """The same on another device."""
        return KeyPoses(self.poses.to(device), self.heights.to(device), self.counts)

    def with_heights(self, heights: Float[Tensor, " M"]) -> KeyPoses:
        """The same poses at other heights, in the same order."""
        return replace(self, heights=heights)

    def at(self, cameras: Int[Tensor, " R"], y: Float[Tensor, " R"]) -> Float[Tensor, "R 3 4"]:
        """The pose of each camera at each height."""
        first = self._segment(cameras, y)
        last = torch.minimum(first + 1, self._ends[cameras] - 1)
        low, high = self.heights[first], self.heights[last]
        fraction = torch.where(last > first, (y - low) / torch.where(last > first, high - low, 1.0), 0.0)
        start, end = self.poses[first], self.poses[last]
        turned = start[:, :, :3] @ rotation_matrix(fraction[:, None] * self._turns[first])
        moved = start[:, :, 3] + fraction[:, None] * (end[:, :, 3] - start[:, :, 3])
        return torch.cat([turned, moved[:, :, None]], dim=-1)

    def _segment(self, cameras: Int[Tensor, " R"], y: Float[Tensor, " R"]) -> Int[Tensor, " R"]:
        """The key pose from which each is interpolated: the last at or before y that has a next one."""
        found = torch.searchsorted(self._places, cameras * self._stride + y.double(), right=True) - 1
        starts = self._ends[cameras] - self._counts[cameras]
        return torch.minimum(torch.maximum(found, starts), (self._ends[cameras] - 2).clamp(min=0)).maximum(
            starts
        )

    @cached_property
    def _counts(self) -> Int[Tensor, " N"]:
        return torch.tensor(self.counts, device=self.poses.device)

    @cached_property
    def _ends(self) -> Int[Tensor, " N"]:
        return self._counts.cumsum(0)

    @cached_property
    def _stride(self) -> float:
        """Further apart than any two heights, so that one sorted list serves all cameras."""
        return 4.0 * float(self.heights.abs().max()) + 4.0

    @cached_property
    def _places(self) -> Float64[Tensor, " M"]:
        owners = torch.arange(len(self.counts), device=self.poses.device).repeat_interleave(self._counts)
        return owners * self._stride + self.heights.double()

    @cached_property
    def _turns(self) -> Float[Tensor, "M 3"]:
        """Rotation vector from each key pose to the next, in its own axes."""
        rotations = self.poses[:, :, :3].double()
        turns = rotation_vector(rotations.transpose(1, 2) @ rotations.roll(-1, 0))
        return turns.to(self.poses)

    def to_json(self) -> dict[str, Any]:
        """Lists of numbers; `from_json` restores the same bits."""
        return {
            "counts": list(self.counts),
            "heights": self.heights.tolist(),
            "poses": self.poses.tolist(),
        }

    @staticmethod
    def from_json(values: dict[str, Any], num_cameras: int) -> KeyPoses:
        """The key poses that `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError, RuntimeError: a part is missing, of another shape or out of its range.
        """
        counts = tuple(values["counts"])
        if len(counts) != num_cameras or not all(type(count) is int and count >= 1 for count in counts):
            raise ValueError(f"key poses need a count of at least 1 for each of {num_cameras} cameras")
        total = sum(counts)
        heights = torch.tensor(values["heights"], dtype=torch.float32).reshape(total)
        poses = torch.tensor(values["poses"], dtype=torch.float32).reshape(total, 3, 4)
        found = KeyPoses(poses, heights, counts)
        if not (poses.isfinite().all() and heights.isfinite().all()):
            raise ValueError("key poses must be finite")
        if not (found._places.diff() > 0).all():
            raise ValueError("the heights of key poses must increase")
        return found
