"""Warp kernels that march rays through an occupancy grid: one work item is one ray.

Samples lie at t = t_near + (i + jitter) * step for integer i. Every lattice point is looked up, empty or not: a step is
about as long as a cell, and a look-up costs less than working out where a cell ends and guessing wrong whether it is
empty. Counting and writing walk the same lattice with the same arithmetic, so that the second pass fills what the first
one counted.
"""

from typing import no_type_check

import warp as wp


@wp.struct
@no_type_check
class Ray:
    """A ray in units of cells."""

    origin: wp.vec3f
    direction: wp.vec3f
    t_first: float
    num_points: int


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
    occupied: wp.array3d(dtype=wp.uint8),
):
    sides = wp.vec3f(float(occupied.shape[0]), float(occupied.shape[1]), float(occupied.shape[2]))
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
    return ray


@wp.func
@no_type_check
def is_occupied(ray: Ray, t: float, occupied: wp.array3d(dtype=wp.uint8)):
    """1 in an occupied cell, else 0; without a branch, which could only be guessed."""
    x = wp.clamp(int(ray.origin[0] + t * ray.direction[0]), 0, occupied.shape[0] - 1)
    y = wp.clamp(int(ray.origin[1] + t * ray.direction[1]), 0, occupied.shape[1] - 1)
    z = wp.clamp(int(ray.origin[2] + t * ray.direction[2]), 0, occupied.shape[2] - 1)
    return wp.min(int(occupied[x, y, z]), 1)


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
    occupied: wp.array3d(dtype=wp.uint8),
    counts: wp.array(dtype=wp.int64),
):
    index = first + wp.tid()
    while index < end:
        ray = ray_at(index, origins, directions, t_near, t_far, jitter, step, occupied)
        count = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
        i = int(0)  # noqa: RUF046, UP018
        while i < ray.num_points:
            count += is_occupied(ray, point_at(ray, step, i), occupied)
            i += 1
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
    occupied: wp.array3d(dtype=wp.uint8),
    packed_info: wp.array2d(dtype=wp.int64),
    ray_indices: wp.array(dtype=wp.int64),
    t_samples: wp.array(dtype=float),
):
    index = first + wp.tid()
    while index < end:
        ray = ray_at(index, origins, directions, t_near, t_far, jitter, step, occupied)
        slot = int(packed_info[index, 0])
        stop = slot + int(packed_info[index, 1])
        i = int(0)  # noqa: RUF046, UP018
        while slot < stop and i < ray.num_points:
            t = point_at(ray, step, i)
            # An empty point's entry is overwritten by the next point's.
            ray_indices[slot] = wp.int64(index)
            t_samples[slot] = t
            slot += is_occupied(ray, t, occupied)
            i += 1
        index += stride
