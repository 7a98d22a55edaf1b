"""Warp kernels that march rays through an occupancy grid: one work item is one ray.

Samples lie at t = t_near + (i + jitter) * step for integer i. Counting and writing walk the same lattice with the same
arithmetic, so that the second pass fills what the first one counted.
"""

from typing import no_type_check

import warp as wp


@wp.func
@no_type_check
def next_occupied(
    index: int,
    origin: wp.vec3f,
    direction: wp.vec3f,
    t_first: float,
    t_far: float,
    step: float,
    occupied: wp.array3d(dtype=wp.uint8),
):
    """First lattice index at or after `index` whose sample lies in an occupied cell; -1 past `t_far`."""
    side_x = occupied.shape[0]
    side_y = occupied.shape[1]
    side_z = occupied.shape[2]
    i = index
    t = t_first + float(i) * step
    while t < t_far:
        x = wp.clamp(int(wp.floor(origin[0] + t * direction[0])), 0, side_x - 1)
        y = wp.clamp(int(wp.floor(origin[1] + t * direction[1])), 0, side_y - 1)
        z = wp.clamp(int(wp.floor(origin[2] + t * direction[2])), 0, side_z - 1)
        if occupied[x, y, z] != wp.uint8(0):
            return i
        # Leave the empty cell: distance to its nearest face ahead, in lattice steps, at least one.
        leave = t_far - t
        for axis in range(3):
            cell = float(x)
            if axis == 1:
                cell = float(y)
            if axis == 2:
                cell = float(z)
            if direction[axis] > 0.0:
                leave = wp.min(leave, (cell + 1.0 - origin[axis]) / direction[axis] - t)
            if direction[axis] < 0.0:
                leave = wp.min(leave, (cell - origin[axis]) / direction[axis] - t)
        i += wp.max(1, int(wp.ceil(leave / step)))
        t = t_first + float(i) * step
    return -1


@wp.kernel(enable_backward=False)
@no_type_check
def count_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_first: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    step: float,
    occupied: wp.array3d(dtype=wp.uint8),
    counts: wp.array(dtype=wp.int64),
):
    ray = first + wp.tid()
    count = int(0)  # noqa: RUF046, UP018 - Warp takes a bare literal for a constant
    i = next_occupied(0, origins[ray], directions[ray], t_first[ray], t_far[ray], step, occupied)
    while i >= 0:
        count += 1
        i = next_occupied(i + 1, origins[ray], directions[ray], t_first[ray], t_far[ray], step, occupied)
    counts[ray] = wp.int64(count)


@wp.kernel(enable_backward=False)
@no_type_check
def write_kernel(
    first: int,
    origins: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    t_first: wp.array(dtype=float),
    t_far: wp.array(dtype=float),
    step: float,
    occupied: wp.array3d(dtype=wp.uint8),
    starts: wp.array(dtype=wp.int64),
    ray_indices: wp.array(dtype=wp.int64),
    t_samples: wp.array(dtype=float),
):
    ray = first + wp.tid()
    slot = starts[ray]
    i = next_occupied(0, origins[ray], directions[ray], t_first[ray], t_far[ray], step, occupied)
    while i >= 0:
        ray_indices[slot] = wp.int64(ray)
        t_samples[slot] = t_first[ray] + float(i) * step
        slot += wp.int64(1)
        i = next_occupied(i + 1, origins[ray], directions[ray], t_first[ray], t_far[ray], step, occupied)
