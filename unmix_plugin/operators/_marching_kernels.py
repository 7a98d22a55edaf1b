"""Warp kernels that march rays through an occupancy grid: one work item is one ray.

Samples lie at t = t_near + (i + jitter) * step for integer i. From an empty lattice point a ray goes on to the first
one that may lie in an occupied cell, by the clearance of the cell: working out where a cell ends costs more. Near
occupied cells several points are looked up at once, empty or not: look-ups that don't wait for one another cost a tenth
of those that do. Counting and writing walk the same lattice with the same arithmetic, so that the second pass fills
what the first one counted.
"""

from typing import no_type_check

import warp as wp

_NEAR = wp.constant(2)
"""Clearance up to which eight points are looked up at once; the number is written out so that the loop is unrolled."""


@wp.struct
@no_type_check
class Ray:
    """A ray in units of cells."""

    origin: wp.vec3f
    direction: wp.vec3f
    t_first: float
    num_points: int
    points_a_cell: float
    """Lattice points that a ray passes while none of its coordinates changes by more than a cell, rounded down."""


@wp.func
@no_type_check
def point_at(ray: Ray, step: float, index: int):
    return ray.t_first + float(index) * step


@wp.func
@no_type_check
def ray_at(
    index: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_near: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
):
    sides = wp.vec3f(float(clearance.shape[0]), float(clearance.shape[1]), float(clearance.shape[2]))
    ray = Ray()
    ray.origin = wp.cw_mul(origins[index], sides)
    ray.direction = wp.cw_mul(directions[index], sides)
    ray.t_first = t_near[index] + jitter[index] * step
    # The quotient may be rounded to either side of the last point before t_far.
    ray.num_points = wp.max(0, int(wp.ceil((t_far[index] - ray.t_first) / step)))
    if ray.num_points > 0 and point_at(ray, step, ray.num_points - 1) >= t_far[index]:
        ray.num_points -= 1
    if point_at(ray, step, ray.num_points) < t_far[index]:
        ray.num_points += 1
    fastest = wp.max(wp.max(wp.abs(ray.direction[0]), wp.abs(ray.direction[1])), wp.abs(ray.direction[2]))
    # A little fewer, since coordinates are rounded; no more than an index can count.
    ray.points_a_cell = wp.min(0.999 / (fastest * step), 1.0e6)
    return ray


@wp.func
@no_type_check
def clearance_at(ray: Ray, t: float, clearance: wp.array3d(dtype=wp.uint8)):
    x = wp.clamp(int(ray.origin[0] + t * ray.direction[0]), 0, clearance.shape[0] - 1)
    y = wp.clamp(int(ray.origin[1] + t * ray.direction[1]), 0, clearance.shape[1] - 1)
    z = wp.clamp(int(ray.origin[2] + t * ray.direction[2]), 0, clearance.shape[2] - 1)
    return int(clearance[x, y, z])


@wp.func
@no_type_check
def points_to_next(ray: Ray, clear: int):
    """Lattice points to the next one that may lie in an occupied cell, from one in a cell of this clearance."""
    return 1 + int(float(wp.max(clear - 1, 0)) * ray.points_a_cell)


@wp.kernel(enable_backward=False)
@no_type_check
def count_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_near: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
    counts: wp.array(dtype=wp.int64),
):
    index = first + wp.tid()
    while index < end:
        ray = ray_at(index, origins, directions, t_near, t_far, jitter, step, clearance)
        count = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
        i = int(0)  # noqa: RUF046, UP018
        while i < ray.num_points:
            clear = clearance_at(ray, point_at(ray, step, i), clearance)
            if clear <= _NEAR:
                for k in range(8):
                    clear = clearance_at(ray, point_at(ray, step, i + k), clearance)
                    count += int(clear == 0 and i + k < ray.num_points)
                i += 7
            i += points_to_next(ray, clear)
        counts[index] = wp.int64(count)
        index += stride


@wp.kernel(enable_backward=False)
@no_type_check
def write_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_near: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
    packed_info: wp.array2d(dtype=wp.int64),
    ray_indices: wp.array(dtype=wp.int64),
    t_samples: wp.array(dtype=float),
):
    index = first + wp.tid()
    while index < end:
        ray = ray_at(index, origins, directions, t_near, t_far, jitter, step, clearance)
        slot = int(packed_info[index, 0])
        stop = slot + int(packed_info[index, 1])
        i = int(0)  # noqa: RUF046, UP018
        while slot < stop and i < ray.num_points:
            clear = clearance_at(ray, point_at(ray, step, i), clearance)
            if clear <= _NEAR:
                for k in range(8):
                    t = point_at(ray, step, i + k)
                    clear = clearance_at(ray, t, clearance)
                    if clear == 0 and slot < stop:
                        ray_indices[slot] = wp.int64(index)
                        t_samples[slot] = t
                        slot += 1
                i += 7
            i += points_to_next(ray, clear)
        index += stride


@wp.kernel(enable_backward=False)
@no_type_check
def first_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_near: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
    counts: wp.array(dtype=wp.int64),
    t_samples: wp.array2d(dtype=float),
):
    # One pass: there is room for as many samples of each ray as are wanted.
    index = first + wp.tid()
    most = t_samples.shape[1]
    while index < end:
        ray = ray_at(index, origins, directions, t_near, t_far, jitter, step, clearance)
        row = t_samples[index]
        slot = int(0)  # noqa: RUF046, UP018
        i = int(0)  # noqa: RUF046, UP018
        while slot < most and i < ray.num_points:
            clear = clearance_at(ray, point_at(ray, step, i), clearance)
            if clear <= _NEAR:
                for k in range(8):
                    t = point_at(ray, step, i + k)
                    clear = clearance_at(ray, t, clearance)
                    if clear == 0 and slot < most and i + k < ray.num_points:
                        row[slot] = t
                        slot += 1
                i += 7
            i += points_to_next(ray, clear)
        counts[index] = wp.int64(slot)
        index += stride
