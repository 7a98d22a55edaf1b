"""Samples along rays, only in the occupied cells of an occupancy grid: over a box, or over contracted space.

Notation: `R` rays, `S` samples in all, stored packed: the samples of a ray are consecutive and `packed_info` holds
(first sample, count) a ray; `t` is in the unit of the ray parameter.

In a box points are in the unit cube that the grid fills, and samples lie at t = t_near + (i + jitter) * step for
integer i. In an unbounded world points are in units of the inner cube's half edge, centred on it. Rays start at their
origins; samples lie `step` apart within the inner cube and farther apart outside, as the contracted cells are: `step` r
up to r = 2, `step` r^2 / 2 beyond, r the maximum norm. They end at r = 512, behind which nothing but the sky is told
apart. Every sample counts for one `step`, however long its interval: density is per unit of contracted space, and a
sample is as opaque anywhere in an untrained field.

Of the kernels a work item is a ray. From an empty point a ray goes on to the first one that may lie in an occupied
cell, by the skips of the cell: working out where a cell ends costs more. In a box, near occupied cells, several points
are looked up at once, empty or not: look-ups that don't wait for one another cost a tenth of those that do. Contraction
lengthens no way by more than a third, in the maximum norm.
"""

from dataclasses import dataclass
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.space import contracted_unit
from unmix_plugin.operators.launching import as_warp, launch, vector_type
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

    def select(self, keep: Bool[Tensor, "S"]) -> "PackedSamples":
        """Only the samples marked in `keep`, still packed."""
        kept_before = torch.cat([keep.new_zeros(1, dtype=torch.int64), keep.cumsum(0)])
        starts = kept_before[self.packed_info[:, 0]]
        ends = kept_before[self.packed_info[:, 0] + self.packed_info[:, 1]]
        t, rays = (values.index_select(0, keep.nonzero()[:, 0]) for values in (self.t, self.ray_indices))
        return PackedSamples(t, rays, torch.stack([starts, ends - starts], dim=-1))


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
    """Rays through a grid, and the kernel that finds their samples."""

    kernel: Any
    lines: tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]
    """Origins and directions."""
    numbers: tuple[Float[Tensor, "R"], ...]
    """What else the kernel takes of each ray."""
    skips: UInt8[Tensor, "X Y Z"]
    step: float

    def first_samples(self, most: int) -> FirstSamples:
        """At most so many samples of each ray by one launch, which writes them where there is room for as many. Raises
        ValueError: step isn't positive."""
        if not self.step > 0:
            raise ValueError(f"step must be positive; got {self.step}")
        num_rays, point = len(self.lines[0]), vector_type(3, torch.float32)
        t = self.lines[0].new_empty(num_rays, most, dtype=torch.float32)
        ends, counts = t.new_empty(num_rays), torch.empty(num_rays, dtype=torch.int64, device=t.device)
        arrays = [as_warp(values.contiguous(), point) for values in self.lines]
        arrays += [as_warp(values.contiguous()) for values in self.numbers]
        launch(
            self.kernel, num_rays, [*arrays, self.step, self.skips.contiguous(), t, counts, ends], t.device
        )
        return FirstSamples(t, counts, ends)

    def samples(self) -> PackedSamples:
        """All samples by one launch, and another with twice the room for each ray where one may have more."""
        num_rays = len(self.lines[0])
        most = max(1, min(_ROOM // max(num_rays, 1), _MOST_SAMPLES))
        found = self.first_samples(most)
        while num_rays and int(found.counts.max()) == most:
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
    """
    return GridRays(_box_kernel, (origins, directions), (t_near, t_far, jitter), skips, step)


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
def _box_skip_at(ray: _Ray, t: float, skips: wp.array3d(dtype=wp.uint8)):
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
def _box_kernel(
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
            clear = _box_skip_at(ray, _point_at(ray, step, i), skips)
            if clear <= _NEAR:
                for k in range(8):
                    t = _point_at(ray, step, i + k)
                    clear = _box_skip_at(ray, t, skips)
                    if clear == 0 and slot < own.shape[0] and i + k < ray.num_points:
                        own[slot] = t
                        last = t
                        slot += 1
                i += 7
            i += _points_to_next(ray, clear)
        counts[index] = wp.int64(slot)
        ends[index] = last + (1.0 - jitter[index]) * step
        index += stride


FAR_RADIUS = 512.0
LINEAR_RADIUS = 2.0


def rays_in_world(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_start: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    skips: UInt8[Tensor, "X Y Z"],
    step: float,
) -> GridRays:
    """Rays whose samples go up to r = 512, as far as they lie in occupied cells of contracted space.

    Args:
        origins, directions: Rays in units of the inner cube's half edge.
        t_start: 0, or the `ends` of the samples before.
        jitter, skips, step: As `rays_in_box` takes them, in the inner cube; the grid fills the cube from -2 to 2.
    """
    return GridRays(_world_kernel, (origins, directions), (t_start, jitter), skips, step)


def march_contracted_twin(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_start: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    skips: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """`rays_in_world(...).samples()` in plain PyTorch: walks all rays at once."""
    t = t_start
    found: list[tuple[Tensor, Tensor]] = []
    while True:
        radius = (origins + t[:, None] * directions).abs().amax(dim=-1)
        is_inside = radius <= FAR_RADIUS
        if not bool(is_inside.any()):
            break
        near = radius.clamp(min=1.0)
        stride = step * near * (near / LINEAR_RADIUS).clamp(min=1.0)
        at = t + jitter * stride
        unit = contracted_unit(origins + at[:, None] * directions)
        hit = is_inside & (skips[tuple(cells_at(unit, skips.shape).unbind(-1))] == 0)
        found.append((hit, at))
        t = torch.where(is_inside, t + stride, t)
    nothing = torch.zeros(len(origins), 0, device=origins.device)
    columns = [torch.stack(values, dim=1) for values in zip(*found, strict=True)]
    return packed_where(*columns) if found else packed_where(nothing > 0, nothing)


@wp.func
@no_type_check
def _radius_at(point: wp.vec3f):
    return wp.max(wp.max(wp.abs(point[0]), wp.abs(point[1])), wp.abs(point[2]))


@wp.func
@no_type_check
def _stride_at(radius: float, step: float):
    near = wp.max(radius, 1.0)
    return step * near * wp.max(near / 2.0, 1.0)


@wp.func
@no_type_check
def _world_skip_at(point: wp.vec3f, skips: wp.array3d(dtype=wp.uint8)):
    radius = wp.max(_radius_at(point), 1.0)
    unit = point * ((2.0 - 1.0 / radius) / radius) / 4.0 + wp.vec3f(0.5, 0.5, 0.5)
    x = wp.clamp(int(unit[0] * float(skips.shape[0])), 0, skips.shape[0] - 1)
    y = wp.clamp(int(unit[1] * float(skips.shape[1])), 0, skips.shape[1] - 1)
    z = wp.clamp(int(unit[2] * float(skips.shape[2])), 0, skips.shape[2] - 1)
    return int(skips[x, y, z])


@wp.func
@no_type_check
def _cube_exit(origin: wp.vec3f, direction: wp.vec3f):
    """Where a ray from within the inner cube leaves it."""
    to_face = wp.vec3f(1.0, 1.0, 1.0) - wp.cw_mul(
        origin, wp.vec3f(wp.sign(direction[0]), wp.sign(direction[1]), wp.sign(direction[2]))
    )
    slowest = 1.0e-9
    x = to_face[0] / wp.max(wp.abs(direction[0]), slowest)
    y = to_face[1] / wp.max(wp.abs(direction[1]), slowest)
    z = to_face[2] / wp.max(wp.abs(direction[2]), slowest)
    return wp.min(wp.min(x, y), z)


@wp.kernel(enable_backward=False)
@no_type_check
def _world_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_start: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    skips: wp.array3d(dtype=wp.uint8),
    t_samples: wp.array2d(dtype=float),
    counts: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=float),
):
    index = first + wp.tid()
    while index < end:
        own = t_samples[index]
        slot = int(0)  # noqa: RUF046, UP018
        t = t_start[index]
        origin, direction = origins[index], directions[index]
        leaves = _cube_exit(origin, direction)
        # A ray may go so far for each cell of clearance; a little less, since coordinates are rounded.
        clear_way = (
            2.99
            / float(wp.max(wp.max(skips.shape[0], skips.shape[1]), skips.shape[2]))
            / _radius_at(direction)
        )
        radius = _radius_at(origin + t * direction)
        while slot < own.shape[0] and radius <= 512.0:
            length = _stride_at(radius, step)
            middle = t + jitter[index] * length
            clear = _world_skip_at(origin + middle * direction, skips)
            # An empty point's entry is overwritten by the next point's.
            own[slot] = middle
            slot += 1 - wp.min(clear, 1)
            if clear > 1 and radius <= 1.0:
                way = wp.min(float(clear - 1) * clear_way, leaves - t)
                length *= float(1 + int(wp.max(way, 0.0) / step))
            t += length
            radius = _radius_at(origin + t * direction)
        counts[index] = wp.int64(slot)
        ends[index] = t
        index += stride
