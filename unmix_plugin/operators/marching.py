"""Samples along rays, only in the occupied cells of an occupancy grid.

Notation: `R` rays, `S` samples in all, stored packed: the samples of a ray are consecutive and `packed_info` holds
(first sample, count) a ray. Points are in the unit cube that the grid fills, `t` in the unit of the ray parameter.

Of the kernels a work item is a ray. Samples lie at t = t_near + (i + jitter) * step for integer i. From an empty
lattice point a ray goes on to the first one that may lie in an occupied cell, by the skips of the cell: working out
where a cell ends costs more. Near occupied cells several points are looked up at once, empty or not: look-ups that
don't wait for one another cost a tenth of those that do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from unmix_plugin.operators.launching import KernelArray, as_warp, launch, vector_type
from unmix_plugin.operators.occupancy import cells_at


@dataclass(frozen=True)
class PackedSamples:
    """Samples of a batch of rays, ray after ray."""

    t: Float[Tensor, "S"]
    """Ray parameter of each sample: the middle of its interval."""
    ray_indices: Int[Tensor, "S"]
    packed_info: Int[Tensor, "R 2"]
    """First sample and number of samples of each ray."""

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, chosen: Int[Tensor, "some"]) -> "PackedSamples":
        """Some samples by their places, with no regard to which belong to one ray: `packed_info` stays as it is."""
        t, rays = (values.index_select(0, chosen) for values in (self.t, self.ray_indices))
        return PackedSamples(t, rays, self.packed_info)

    def select(self, keep: Bool[Tensor, "S"]) -> "PackedSamples":
        """Only the samples marked in `keep`, still packed."""
        kept_before = torch.cat([keep.new_zeros(1, dtype=torch.int64), keep.cumsum(0)])
        starts = kept_before[self.packed_info[:, 0]]
        ends = kept_before[self.packed_info[:, 0] + self.packed_info[:, 1]]
        return replace(
            self.rows(keep.nonzero()[:, 0]), packed_info=torch.stack([starts, ends - starts], dim=-1)
        )


@dataclass(frozen=True)
class FirstSamples:
    """The first samples of rays, in rows of one length M."""

    t: Float[Tensor, "R M"]
    """Ray parameters; behind a ray's last sample anything."""
    counts: Int[Tensor, "R"]
    """Samples of each; less than M if there are no more."""
    ends: Float[Tensor, "R"]
    """From where to march on for more; anything if there are none."""


@dataclass(frozen=True)
class GridRays:
    """Rays through a grid, as a kernel takes them."""

    origins: Float[Tensor, "R 3"]
    kernel: Any
    arguments: list[KernelArray | Tensor | float]
    """Its first ones."""

    @staticmethod
    def of(
        kernel: Any,
        lines: Sequence[Float[Tensor, "R 3"]],
        numbers: Sequence[Float[Tensor, "R"]],
        skips: UInt8[Tensor, "X Y Z"],
        step: float,
    ) -> "GridRays":
        """Rays of origins and directions, with what else the kernel takes of each ray, in float32. Raises ValueError:
        step isn't positive."""
        check_step(step)
        point = vector_type(3, torch.float32)
        arrays = [as_warp(values.contiguous(), point) for values in lines]
        numbers = [values.contiguous() for values in numbers]
        return GridRays(lines[0], kernel, [*arrays, *numbers, step, skips.contiguous()])

    def first_samples(self, most: int) -> FirstSamples:
        """At most so many samples of each ray by one launch, which writes them where there is room for as many."""
        num_rays = len(self.origins)
        t = self.origins.new_empty(num_rays, most, dtype=torch.float32)
        ends = self.origins.new_empty(num_rays, dtype=torch.float32)
        counts = torch.empty(num_rays, dtype=torch.int64, device=t.device)
        launch(self.kernel, num_rays, [*self.arguments, t, counts, ends], t.device)
        return FirstSamples(t, counts, ends)

    def samples(self) -> PackedSamples:
        """All samples by one launch, and another with twice the room for each ray where one may have more."""
        most = max(1, min(_ROOM // max(len(self.origins), 1), _MOST_SAMPLES))
        found = self.first_samples(most)
        while len(self.origins) and int(found.counts.max()) == most:
            most *= 2
            found = self.first_samples(most)
        starts = most * torch.arange(len(found.counts), device=found.counts.device)
        rays, rows, packed_info = packed_rows(starts, found.counts)
        return PackedSamples(found.t.view(-1).index_select(0, rows), rays, packed_info)


_ROOM, _MOST_SAMPLES = 1 << 22, 1024
"""Samples of all rays, and of one, that there is room for at first."""


def packed_rows(
    starts: Int[Tensor, "R"], counts: Int[Tensor, "R"]
) -> tuple[Int[Tensor, "S"], Int[Tensor, "S"], Int[Tensor, "R 2"]]:
    """Of so many rows from each ray's first on: which ray each is of, the rows, and where they lie when packed."""
    ends = counts.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    rays = torch.repeat_interleave(counts, output_size=total)
    shifts = (starts - ends + counts).index_select(0, rays)
    rows = shifts.add_(torch.arange(total, device=counts.device))
    return rays, rows, torch.stack([ends - counts, counts], dim=-1)


def rays_in_box(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    skips: UInt8[Tensor, "X Y Z"],
    step: float,
) -> GridRays:
    """Rays whose samples are at t_near + (i + jitter) step, as far as that lies in occupied cells.

    Args:
        origins, directions: Rays in unit-cube coordinates; directions need not have unit length.
        t_near, t_far: Where each ray enters and leaves the unit cube; t_far <= t_near marks a miss.
        jitter: Offset of each ray's lattice in steps, [0, 1).
        skips: 0 in occupied cells, as `skip_distances` says; cell (x, y, z) is [x/X, (x+1)/X] and so on.
        step: Distance of neighbouring samples in the ray parameter, > 0.
    Raises:
        ValueError: step isn't positive.
    """
    return GridRays.of(_write_kernel, (origins, directions), (t_near, t_far, jitter), skips, step)


def march_twin(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    skips: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """`rays_in_box(...).samples()` in plain PyTorch: tests every lattice point of every ray."""
    check_step(step)
    t_first = t_near + jitter * step
    longest = float((t_far - t_first).max()) if len(t_far) else 0.0
    index = torch.arange(max(int(longest / step) + 2, 1), device=origins.device)
    t = t_first[:, None] + index * step
    points = origins[:, None] + t[..., None] * directions[:, None]
    cells = cells_at(points, skips.shape)
    hit = (t < t_far[:, None]) & (skips[tuple(cells.unbind(-1))] == 0)
    return packed_where(hit, t)


def packed_where(hit: Bool[Tensor, "R M"], t: Float[Tensor, "R M"]) -> PackedSamples:
    """The samples that are marked."""
    counts = hit.sum(dim=1)
    info = torch.stack([counts.cumsum(0) - counts, counts], dim=-1)
    return PackedSamples(t[hit], hit.nonzero()[:, 0], info)


def check_step(step: float) -> None:
    """Refuse a distance of samples that isn't positive."""
    if not step > 0:
        raise ValueError(f"step must be positive; got {step}")


_NEAR = wp.constant(2)
"""Clearance up to which eight points are looked up at once; the number is written out so that the loop is unrolled."""


@wp.struct
@no_type_check
class _Ray:
    """A ray in units of cells."""

    origin: wp.vec3f
    direction: wp.vec3f
    t_first: float
    num_points: int
    points_a_cell: float
    """Lattice points that a ray passes while none of its coordinates changes by more than a cell, rounded down."""


@wp.func
@no_type_check
def _point_at(ray: _Ray, step: float, index: int):
    return ray.t_first + float(index) * step


@wp.func
@no_type_check
def _ray_at(
    index: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_near: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    skips: wp.array3d(dtype=wp.uint8),
):
    sides = wp.vec3f(float(skips.shape[0]), float(skips.shape[1]), float(skips.shape[2]))
    ray = _Ray()
    ray.origin = wp.cw_mul(origins[index], sides)
    ray.direction = wp.cw_mul(directions[index], sides)
    ray.t_first = t_near[index] + jitter[index] * step
    # The quotient may be rounded to either side of the last point before t_far.
    ray.num_points = wp.max(0, int(wp.ceil((t_far[index] - ray.t_first) / step)))
    if ray.num_points > 0 and _point_at(ray, step, ray.num_points - 1) >= t_far[index]:
        ray.num_points -= 1
    if _point_at(ray, step, ray.num_points) < t_far[index]:
        ray.num_points += 1
    fastest = wp.max(wp.max(wp.abs(ray.direction[0]), wp.abs(ray.direction[1])), wp.abs(ray.direction[2]))
    # A little fewer, since coordinates are rounded; no more than an index can count.
    ray.points_a_cell = wp.min(0.999 / (fastest * step), 1.0e6)
    return ray


@wp.func
@no_type_check
def _skip_at(ray: _Ray, t: float, skips: wp.array3d(dtype=wp.uint8)):
    x = wp.clamp(int(ray.origin[0] + t * ray.direction[0]), 0, skips.shape[0] - 1)
    y = wp.clamp(int(ray.origin[1] + t * ray.direction[1]), 0, skips.shape[1] - 1)
    z = wp.clamp(int(ray.origin[2] + t * ray.direction[2]), 0, skips.shape[2] - 1)
    return int(skips[x, y, z])


@wp.func
@no_type_check
def _points_to_next(ray: _Ray, clear: int):
    """Lattice points to the next one that may lie in an occupied cell, from one in a cell of this skips."""
    return 1 + int(float(wp.max(clear - 1, 0)) * ray.points_a_cell)


@wp.kernel(enable_backward=False)
@no_type_check
def _write_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_near: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    skips: wp.array3d(dtype=wp.uint8),
    t_samples: wp.array2d(dtype=float),
    counts: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=float),
):
    index = first + wp.tid()
    while index < end:
        ray = _ray_at(index, origins, directions, t_near, t_far, jitter, step, skips)
        own = t_samples[index]
        slot = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
        i = int(0)  # noqa: RUF046, UP018
        last = ray.t_first
        while slot < own.shape[0] and i < ray.num_points:
            clear = _skip_at(ray, _point_at(ray, step, i), skips)
            if clear <= _NEAR:
                for k in range(8):
                    t = _point_at(ray, step, i + k)
                    clear = _skip_at(ray, t, skips)
                    if clear == 0 and slot < own.shape[0] and i + k < ray.num_points:
                        own[slot] = t
                        last = t
                        slot += 1
                i += 7
            i += _points_to_next(ray, clear)
        counts[index] = wp.int64(slot)
        ends[index] = last + (1.0 - jitter[index]) * step
        index += stride
