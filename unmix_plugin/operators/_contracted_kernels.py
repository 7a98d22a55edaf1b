"""Warp kernels that march rays through contracted space: one work item is one ray.

Counting and writing walk the same points with the same arithmetic, so that the second pass fills what the first one
counted. The constants are those of contracted_marching.py.
"""

from typing import no_type_check

import warp as wp


@wp.func
@no_type_check
def radius_at(point: wp.vec3f):
    return wp.max(wp.max(wp.abs(point[0]), wp.abs(point[1])), wp.abs(point[2]))


@wp.func
@no_type_check
def stride_at(radius: float, step: float):
    near = wp.max(radius, 1.0)
    return step * near * wp.max(near / 2.0, 1.0)


@wp.func
@no_type_check
def is_occupied(point: wp.vec3f, clearance: wp.array3d(dtype=wp.uint8)):
    """1 in an occupied cell, else 0."""
    radius = wp.max(radius_at(point), 1.0)
    unit = point * ((2.0 - 1.0 / radius) / radius) / 4.0 + wp.vec3f(0.5, 0.5, 0.5)
    x = wp.clamp(int(unit[0] * float(clearance.shape[0])), 0, clearance.shape[0] - 1)
    y = wp.clamp(int(unit[1] * float(clearance.shape[1])), 0, clearance.shape[1] - 1)
    z = wp.clamp(int(unit[2] * float(clearance.shape[2])), 0, clearance.shape[2] - 1)
    return 1 - wp.min(int(clearance[x, y, z]), 1)


@wp.kernel(enable_backward=False)
@no_type_check
def count_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
    counts: wp.array(dtype=wp.int64),
):
    index = first + wp.tid()
    while index < end:
        count = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
        t = float(0.0)  # noqa: UP018
        radius = radius_at(origins[index])
        while radius <= 512.0:
            length = stride_at(radius, step)
            count += is_occupied(origins[index] + (t + jitter[index] * length) * directions[index], clearance)
            t += length
            radius = radius_at(origins[index] + t * directions[index])
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
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
    packed_info: wp.array2d(dtype=wp.int64),
    ray_indices: wp.array(dtype=wp.int64),
    t_samples: wp.array(dtype=float),
):
    index = first + wp.tid()
    while index < end:
        slot = int(packed_info[index, 0])
        stop = slot + int(packed_info[index, 1])
        t = float(0.0)  # noqa: UP018
        radius = radius_at(origins[index])
        while slot < stop and radius <= 512.0:
            length = stride_at(radius, step)
            middle = t + jitter[index] * length
            # An empty point's entry is overwritten by the next point's.
            ray_indices[slot] = wp.int64(index)
            t_samples[slot] = middle
            slot += is_occupied(origins[index] + middle * directions[index], clearance)
            t += length
            radius = radius_at(origins[index] + t * directions[index])
        index += stride


@wp.kernel(enable_backward=False)
@no_type_check
def first_kernel(
    first: int,
    end: int,
    stride: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    jitter: wp.array(dtype=float),
    step: float,
    clearance: wp.array3d(dtype=wp.uint8),
    t_start: wp.array(dtype=float),
    counts: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=float),
    t_samples: wp.array2d(dtype=float),
):
    # One pass: there is room for as many samples of each ray as are wanted.
    index = first + wp.tid()
    most = t_samples.shape[1]
    while index < end:
        row = t_samples[index]
        slot = int(0)  # noqa: RUF046, UP018
        t = t_start[index]
        radius = radius_at(origins[index] + t * directions[index])
        while slot < most and radius <= 512.0:
            length = stride_at(radius, step)
            middle = t + jitter[index] * length
            row[slot] = middle
            slot += is_occupied(origins[index] + middle * directions[index], clearance)
            t += length
            radius = radius_at(origins[index] + t * directions[index])
        counts[index] = wp.int64(slot)
        ends[index] = t
        index += stride
