"""Poses of line cameras: a function of the row, interpolated between key poses; and which row sees a point.

A line camera takes one row of its image after the other while it moves, so each row has a pose of its own. Between key
poses the rotation turns about one axis at an even rate (slerp) and the position moves along a straight line; beyond the
first and the last key pose, by half a row at most, both go on.

Notation: `N` cameras, `M` key poses of all cameras, `R` rays, `P` points; `y` is a height in the image in pixels, so
row r is taken at y = r + 0.5. A frame camera has one key pose, which holds for all rows. `w` is a rotation vector: its
direction is the axis, its length the angle in radians.

Source: Rodrigues' formula; see Sola et al. 2018, A micro Lie theory for state estimation in robotics, example 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, TypeAlias

import msgspec
import torch
from jaxtyping import Bool, Float, Float64, Int
from msgspec import Meta
from torch import Tensor

_Row: TypeAlias = tuple[float, float, float, float]
WrittenPose: TypeAlias = tuple[_Row, _Row, _Row]
"""A pose in files, row by row."""


class WrittenKeyPoses(msgspec.Struct):
    """What `KeyPoses.to_json` writes."""

    counts: list[Annotated[int, Meta(ge=1)]]
    heights: list[float]
    poses: list[WrittenPose]


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

    def at(self, cameras: Int[Tensor, " R"], y: Float[Tensor, " R"]) -> Float[Tensor, "R 3 4"]:
        """The pose of each camera at each height."""
        # The key pose from which each is interpolated: the last at or before y that has a next one.
        ends = self._ends[cameras]
        found = torch.searchsorted(self._places, cameras * self._stride + y.double(), right=True) - 1
        starts = ends - self._counts[cameras]
        first = found.maximum(starts).minimum((ends - 2).clamp(min=0)).maximum(starts)
        last = torch.minimum(first + 1, ends - 1)
        low, high = self.heights[first], self.heights[last]
        fraction = torch.where(last > first, (y - low) / torch.where(last > first, high - low, 1.0), 0.0)
        start, end = self.poses[first], self.poses[last]
        turned = start[:, :, :3] @ rotation_matrix(fraction[:, None] * self._turns[first])
        moved = start[:, :, 3] + fraction[:, None] * (end[:, :, 3] - start[:, :, 3])
        return torch.cat([turned, moved[:, :, None]], dim=-1)

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
        """Lists of numbers; `read` restores the same bits."""
        return {
            "counts": list(self.counts),
            "heights": self.heights.tolist(),
            "poses": self.poses.tolist(),
        }

    @staticmethod
    def read(written: WrittenKeyPoses, num_cameras: int) -> KeyPoses:
        """The key poses that `to_json` wrote. Raises ValueError, RuntimeError: parts that don't fit each other, or
        numbers out of their range."""
        counts, total = written.counts, sum(written.counts)
        if len(counts) != num_cameras or not len(written.heights) == len(written.poses) == total:
            raise ValueError(
                f"key poses need counts for each of {num_cameras} cameras, and as many heights and poses as these say"
            )
        heights = torch.tensor(written.heights, dtype=torch.float32).reshape(total)
        poses = torch.tensor(written.poses, dtype=torch.float32).reshape(total, 3, 4)
        found = KeyPoses(poses, heights, tuple(counts))
        if not (are_rigid(poses) and heights.isfinite().all()):
            raise ValueError("key poses must be rotations and finite positions")
        if not (found._places.diff() > 0).all():
            raise ValueError("the heights of key poses must increase")
        return found


_ROUNDING = 5e-3
"""Largest element of R^T R - 1 of a rotation in float32, with a margin."""


def are_rigid(poses: Float[Tensor, "N 3 4"]) -> bool:
    """Whether all are a rotation and a finite position: others, as of a damaged file, would show a skewed scene."""
    rotations = poses[:, :, :3].double()
    off = (rotations.mT @ rotations - torch.eye(3, dtype=torch.float64, device=poses.device)).abs()
    is_rotation = bool((off < _ROUNDING).all() and (torch.linalg.det(rotations) > 0).all())
    return is_rotation and bool(poses.isfinite().all())


_MOST_STRIPES = 400
"""Stripes of the image that are looked through for a point; within one, points move evenly in the camera's axes."""

_CHUNK = 1 << 14
"""Points looked up at once."""


def project_by_row(
    points: Float[Tensor, "P 3"], keys: KeyPoses, num_rows: int
) -> tuple[Float[Tensor, " P"], Float[Tensor, "P 3"]]:
    """The height y in [0, num_rows] at which a line camera with these key poses first sees each point, and where it
    lies in the camera's axes then; a point that no row sees has z = 1, behind the camera."""
    num_stripes = min(num_rows, _MOST_STRIPES)
    heights = torch.linspace(0, num_rows, num_stripes + 1, device=points.device)
    poses = keys.at(torch.zeros_like(heights, dtype=torch.int64), heights)
    stripes, found = _first_stripes(points, poses)
    seen = found.nonzero()[:, 0]
    start, end = (_local(points[seen], poses[stripes[seen] + side]) for side in (0, 1))
    change = end[:, 1] - start[:, 1]
    share = torch.where(change == 0, 0.5, -start[:, 1] / torch.where(change == 0, 1.0, change)).clamp(0, 1)
    y, local = torch.zeros_like(points[:, 0]), torch.ones_like(points)
    y[seen] = (stripes[seen] + share) * (num_rows / num_stripes)
    local[seen] = start + share[:, None] * (end - start)
    return y, local


def _first_stripes(
    points: Float[Tensor, "P 3"], poses: Float[Tensor, "n 3 4"]
) -> tuple[Int[Tensor, " P"], Bool[Tensor, " P"]]:
    """The first stripe between neighbouring poses that passes over each point, and whether there is one."""
    stripes = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    # One product gives each point's coordinate in each pose; a chunk of points keeps it small. Poses lie along the
    # first axis, so that comparing neighbours takes whole rows of memory.
    up, back = (
        (poses[:, :, axis], (poses[:, :, 3] * poses[:, :, axis]).sum(dim=1, keepdim=True)) for axis in (1, 2)
    )
    count = len(poses) - 1
    ranks = torch.arange(count, 0, -1, dtype=torch.int16, device=points.device)[:, None]
    for first in range(0, len(points), _CHUNK):
        chosen = points[first : first + _CHUNK].T.contiguous()
        is_above, is_before = up[0] @ chosen > up[1], back[0] @ chosen < back[1]
        passes = (is_above[1:] ^ is_above[:-1]) & is_before[1:] & is_before[:-1]
        stripes[first : first + _CHUNK] = count - (passes * ranks).amax(dim=0).long()
    return stripes.clamp(max=count - 1), stripes < count


def _local(points: Float[Tensor, "P 3"], poses: Float[Tensor, "P 3 4"]) -> Float[Tensor, "P 3"]:
    """Points in the axes of their poses."""
    return torch.einsum("pi,pij->pj", points - poses[:, :, 3], poses[:, :, :3])


_SMALL = 1e-6
"""Squared angle below which series replace the closed forms."""


def rotation_matrix(w: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """exp([w]x); differentiable everywhere, also at 0."""
    squared = (w * w).sum(dim=-1)[..., None, None]
    is_small = squared < _SMALL
    safe = torch.where(is_small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(is_small, 1 - squared / 6, angle.sin() / angle)
    second = torch.where(is_small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    cross = _cross_matrix(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + first * cross + second * (cross @ cross)


def rotation_vector(matrix: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """The inverse of `rotation_matrix` for angles below pi."""
    skew = 0.5 * (matrix - matrix.transpose(-1, -2))
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    sine = axis.norm(dim=-1, keepdim=True)
    cosine = 0.5 * (matrix.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1)
    angle = torch.atan2(sine, cosine)
    return axis * torch.where(sine * sine < _SMALL, 1 + angle * angle / 6, angle / sine.clamp(min=1e-12))


def _cross_matrix(w: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """[w]x, with which a product is the cross product by w."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
