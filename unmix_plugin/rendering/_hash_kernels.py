"""Warp kernels of the hash encoding: one work item is one (level, sample) pair, levels outermost.

Levels outermost lets a CPU thread own a whole level's table in the backward pass, so that plain additions suffice there
(on CUDA the same call is atomic) and the table of the level at work stays in cache. `levels` holds (cells a side, first
row, rows) a level; a table row and an encoded level are vectors of one level's features; `Any` serves float32 training
and float64 checks.
"""

from typing import Any, no_type_check

import warp as wp

_PRIME_Y = wp.constant(wp.uint32(2654435761))
_PRIME_Z = wp.constant(wp.uint32(805459861))


@wp.func
@no_type_check
def row_in_level(x: int, y: int, z: int, side: int, num_rows: int, is_dense: bool):
    if is_dense:
        return x + side * (y + side * z)
    hashed = wp.uint32(x) ^ (wp.uint32(y) * _PRIME_Y) ^ (wp.uint32(z) * _PRIME_Z)
    return wp.int32(hashed & wp.uint32(num_rows - 1))


@wp.func
@no_type_check
def fits_densely(side: int, num_rows: int):
    return wp.int64(side) * wp.int64(side) * wp.int64(side) <= wp.int64(num_rows)


@wp.func
@no_type_check
def cell_corner(point: Any, resolution: int):
    # The last cell also takes the far face; a point outside the unit cube gets its nearest cell's extension.
    low = type(point[0])(0.0)
    high = type(point[0])(resolution - 1)
    return type(point)(
        wp.clamp(wp.floor(point[0]), low, high),
        wp.clamp(wp.floor(point[1]), low, high),
        wp.clamp(wp.floor(point[2]), low, high),
    )


@wp.func
@no_type_check
def linear_weight(fraction: Any, upper: int):
    if upper == 1:
        return fraction
    return type(fraction)(1.0) - fraction


@wp.func
@no_type_check
def linear_slope(fraction: Any, upper: int):
    if upper == 1:
        return type(fraction)(1.0)
    return type(fraction)(-1.0)


@wp.kernel(enable_backward=False)
@no_type_check
def encode_kernel(
    first: int,
    num_samples: int,
    positions: wp.array(dtype=Any),
    table: wp.array(dtype=Any),
    levels: wp.array2d(dtype=int),
    encoded: wp.array2d(dtype=Any),
):
    item = first + wp.tid()
    level = item // num_samples
    sample = item - level * num_samples
    resolution = levels[level, 0]
    first_row = levels[level, 1]
    num_rows = levels[level, 2]
    is_dense = fits_densely(resolution + 1, num_rows)
    point = positions[sample]
    point = point * type(point[0])(resolution)
    corner = cell_corner(point, resolution)
    fraction = point - corner
    x = int(corner[0])
    y = int(corner[1])
    z = int(corner[2])
    total = type(table[0])()
    for k in range(8):
        ux = k & 1
        uy = (k >> 1) & 1
        uz = k >> 2
        row = first_row + row_in_level(x + ux, y + uy, z + uz, resolution + 1, num_rows, is_dense)
        weight = (
            linear_weight(fraction[0], ux) * linear_weight(fraction[1], uy) * linear_weight(fraction[2], uz)
        )
        total += table[row] * weight
    encoded[sample, level] = total


@wp.kernel(enable_backward=False)
@no_type_check
def table_gradient_kernel(
    first: int,
    num_samples: int,
    positions: wp.array(dtype=Any),
    encoded_gradient: wp.array2d(dtype=Any),
    levels: wp.array2d(dtype=int),
    table_gradient: wp.array(dtype=Any),
):
    item = first + wp.tid()
    level = item // num_samples
    sample = item - level * num_samples
    resolution = levels[level, 0]
    first_row = levels[level, 1]
    num_rows = levels[level, 2]
    is_dense = fits_densely(resolution + 1, num_rows)
    point = positions[sample]
    point = point * type(point[0])(resolution)
    corner = cell_corner(point, resolution)
    fraction = point - corner
    x = int(corner[0])
    y = int(corner[1])
    z = int(corner[2])
    gradient = encoded_gradient[sample, level]
    for k in range(8):
        ux = k & 1
        uy = (k >> 1) & 1
        uz = k >> 2
        row = first_row + row_in_level(x + ux, y + uy, z + uz, resolution + 1, num_rows, is_dense)
        weight = (
            linear_weight(fraction[0], ux) * linear_weight(fraction[1], uy) * linear_weight(fraction[2], uz)
        )
        wp.atomic_add(table_gradient, row, gradient * weight)


@wp.kernel(enable_backward=False)
@no_type_check
def position_gradient_kernel(
    first: int,
    positions: wp.array(dtype=Any),
    table: wp.array(dtype=Any),
    encoded_gradient: wp.array2d(dtype=Any),
    levels: wp.array2d(dtype=int),
    position_gradient: wp.array(dtype=Any),
):
    sample = first + wp.tid()
    total = type(positions[0])()
    for level in range(levels.shape[0]):
        resolution = levels[level, 0]
        first_row = levels[level, 1]
        num_rows = levels[level, 2]
        is_dense = fits_densely(resolution + 1, num_rows)
        point = positions[sample]
        scale = type(point[0])(resolution)
        point = point * scale
        corner = cell_corner(point, resolution)
        fraction = point - corner
        x = int(corner[0])
        y = int(corner[1])
        z = int(corner[2])
        gradient = encoded_gradient[sample, level]
        for k in range(8):
            ux = k & 1
            uy = (k >> 1) & 1
            uz = k >> 2
            row = first_row + row_in_level(x + ux, y + uy, z + uz, resolution + 1, num_rows, is_dense)
            wx = linear_weight(fraction[0], ux)
            wy = linear_weight(fraction[1], uy)
            wz = linear_weight(fraction[2], uz)
            slope = type(point)(
                linear_slope(fraction[0], ux) * wy * wz,
                wx * linear_slope(fraction[1], uy) * wz,
                wx * wy * linear_slope(fraction[2], uz),
            )
            total += slope * (scale * wp.dot(table[row], gradient))
    position_gradient[sample] = total
