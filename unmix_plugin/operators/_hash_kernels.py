"""Warp kernels of the hash encoding: one work item is one (level, sample) pair, levels outermost.

So a CPU thread walks one level's samples after the other: the level's constants are worked out once, its table stays in
cache, and where a thread has all samples of a level, plain additions suffice in the backward pass (on CUDA the same
call is atomic). `levels` holds (cells a side, first row, rows) a level; a table row and an encoded level are vectors of
one level's features; `Any` serves float32 training and float64 checks.

Rows are worked out in uint32, whose overflow belongs to the hash. The sign bit is cleared before one becomes an index,
so that no code for negative indices is left in the innermost loop.
"""

from typing import Any, no_type_check

import warp as wp

_PRIME_Y = wp.constant(wp.uint32(2654435761))
_PRIME_Z = wp.constant(wp.uint32(805459861))
_NO_SIGN = wp.constant(wp.uint32(0x7FFFFFFF))
_ONE = wp.constant(wp.uint32(1))


@wp.struct
@no_type_check
class Level:
    """One level of the grid; a vertex' row is a sum (dense) or a hash of its x and its y and z times the factors."""

    resolution: int
    first_row: int
    num_rows: int
    is_dense: bool
    factor_y: wp.uint32
    factor_z: wp.uint32
    mask: wp.uint32


@wp.func
@no_type_check
def level_at(levels: wp.array2d(dtype=int), index: int):
    level = Level()
    level.resolution = levels[index, 0]
    level.first_row = levels[index, 1]
    level.num_rows = levels[index, 2]
    side = wp.int64(level.resolution + 1)
    level.is_dense = side * side * side <= wp.int64(level.num_rows)
    level.factor_y = _PRIME_Y
    level.factor_z = _PRIME_Z
    if level.is_dense:
        level.factor_y = wp.uint32(side)
        level.factor_z = wp.uint32(side * side)
    level.mask = wp.uint32(level.num_rows - 1) & _NO_SIGN
    return level


@wp.func
@no_type_check
def cell_at(coordinate: Any, resolution: int):
    # The last cell also takes the far face; a point outside the unit cube gets its nearest cell's extension. Rounding
    # towards 0 instead of down differs only below 0, where the cell is 0 either way.
    return wp.clamp(int(coordinate), 0, resolution - 1)


@wp.func
@no_type_check
def locate(position: Any, level: Level):
    """The cell that a position lies in, and where in it as a part of the cell's edge."""
    point = position * type(position[0])(level.resolution)
    x = cell_at(point[0], level.resolution)
    y = cell_at(point[1], level.resolution)
    z = cell_at(point[2], level.resolution)
    u = point[0] - type(point[0])(x)
    v = point[1] - type(point[0])(y)
    w = point[2] - type(point[0])(z)
    return x, y, z, u, v, w


@wp.func
@no_type_check
def row(x: wp.uint32, y: wp.uint32, z: wp.uint32, level: Level):
    if level.is_dense:
        return int((x + y + z) & _NO_SIGN)
    return int((x ^ y ^ z) & level.mask)


@wp.func
@no_type_check
def rows_of_cell(x: int, y: int, z: int, level: Level):
    """Rows of a cell's vertices within the level; x changes fastest, then y."""
    x0 = wp.uint32(x)
    y0 = wp.uint32(y) * level.factor_y
    z0 = wp.uint32(z) * level.factor_z
    x1 = x0 + _ONE
    y1 = y0 + level.factor_y
    z1 = z0 + level.factor_z
    return (
        row(x0, y0, z0, level),
        row(x1, y0, z0, level),
        row(x0, y1, z0, level),
        row(x1, y1, z0, level),
        row(x0, y0, z1, level),
        row(x1, y0, z1, level),
        row(x0, y1, z1, level),
        row(x1, y1, z1, level),
    )


@wp.func
@no_type_check
def between(low: Any, high: Any, fraction: Any):
    return low + (high - low) * fraction


@wp.func
@no_type_check
def add_along_x(rows: wp.array(dtype=Any), low: int, high: int, gradient: Any, fraction: Any):
    upper = gradient * fraction
    wp.atomic_add(rows, low, gradient - upper)
    wp.atomic_add(rows, high, upper)


@wp.kernel(enable_backward=False)
@no_type_check
def encode_kernel(
    first: int,
    end: int,
    stride: int,
    positions: wp.array(dtype=Any),
    table: wp.array(dtype=Any),
    levels: wp.array2d(dtype=int),
    encoded: wp.array2d(dtype=Any),
):
    num_samples = positions.shape[0]
    item = first + wp.tid()
    while item < end:
        index = item // num_samples
        sample = item - index * num_samples
        stop = wp.min(end - index * num_samples, num_samples)
        level = level_at(levels, index)
        rows = table[level.first_row : level.first_row + level.num_rows]
        while sample < stop:
            x, y, z, u, v, w = locate(positions[sample], level)
            a, b, c, d, e, f, g, h = rows_of_cell(x, y, z, level)
            near = between(between(rows[a], rows[b], u), between(rows[c], rows[d], u), v)
            far = between(between(rows[e], rows[f], u), between(rows[g], rows[h], u), v)
            encoded[sample, index] = between(near, far, w)
            sample += stride
        item = index * num_samples + sample


@wp.kernel(enable_backward=False)
@no_type_check
def table_gradient_kernel(
    first: int,
    end: int,
    stride: int,
    positions: wp.array(dtype=Any),
    encoded_gradient: wp.array2d(dtype=Any),
    levels: wp.array2d(dtype=int),
    table_gradient: wp.array(dtype=Any),
):
    # The interpolation backwards: the gradient is split along z, then along y, then along x.
    num_samples = positions.shape[0]
    item = first + wp.tid()
    while item < end:
        index = item // num_samples
        sample = item - index * num_samples
        stop = wp.min(end - index * num_samples, num_samples)
        level = level_at(levels, index)
        rows = table_gradient[level.first_row : level.first_row + level.num_rows]
        while sample < stop:
            x, y, z, u, v, w = locate(positions[sample], level)
            a, b, c, d, e, f, g, h = rows_of_cell(x, y, z, level)
            gradient = encoded_gradient[sample, index]
            far = gradient * w
            near = gradient - far
            far_high = far * v
            near_high = near * v
            add_along_x(rows, a, b, near - near_high, u)
            add_along_x(rows, c, d, near_high, u)
            add_along_x(rows, e, f, far - far_high, u)
            add_along_x(rows, g, h, far_high, u)
            sample += stride
        item = index * num_samples + sample


@wp.kernel(enable_backward=False)
@no_type_check
def position_gradient_kernel(
    first: int,
    end: int,
    stride: int,
    positions: wp.array(dtype=Any),
    table: wp.array(dtype=Any),
    encoded_gradient: wp.array2d(dtype=Any),
    levels: wp.array2d(dtype=int),
    position_gradient: wp.array(dtype=Any),
):
    # Here an item is a sample, whose levels are summed up.
    sample = first + wp.tid()
    while sample < end:
        total = type(positions[0])()
        for index in range(levels.shape[0]):
            level = level_at(levels, index)
            rows = table[level.first_row : level.first_row + level.num_rows]
            x, y, z, u, v, w = locate(positions[sample], level)
            a, b, c, d, e, f, g, h = rows_of_cell(x, y, z, level)
            along_x = between(
                between(rows[b] - rows[a], rows[d] - rows[c], v),
                between(rows[f] - rows[e], rows[h] - rows[g], v),
                w,
            )
            near_low = between(rows[a], rows[b], u)
            near_high = between(rows[c], rows[d], u)
            far_low = between(rows[e], rows[f], u)
            far_high = between(rows[g], rows[h], u)
            along_y = between(near_high - near_low, far_high - far_low, w)
            along_z = between(far_low - near_low, far_high - near_high, v)
            incoming = encoded_gradient[sample, index] * type(total[0])(level.resolution)
            total += type(total)(
                wp.dot(along_x, incoming), wp.dot(along_y, incoming), wp.dot(along_z, incoming)
            )
        position_gradient[sample] = total
        sample += stride
