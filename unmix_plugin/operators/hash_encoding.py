"""Multiresolution hash encoding of positions in the unit cube.

Notation: `S` samples, `L` levels, `F` features a level, `R` rows of the table over all levels. A level of n cells a
side has (n + 1)^3 vertices; where they fit, the level is a dense grid, else its vertices share rows through a hash.

Source: Mueller et al. 2022, Instant Neural Graphics Primitives, section 3.

Of the kernels a work item is one (level, sample) pair, levels outermost. So a CPU thread walks one level's samples
after the other: the level's constants are worked out once, its table stays in cache, and where a thread has all samples
of a level, plain additions suffice in the backward pass (on CUDA the same call is atomic). `levels` holds (cells a
side, first row, rows) a level; a table row and an encoded level are vectors of one level's features; `Any` serves
float32 training and float64 checks.

Rows are worked out in uint32, whose overflow belongs to the hash. The sign bit is cleared before one becomes an index,
so that no code for negative indices is left in the innermost loop.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.operators.launching import as_warp, declare, launch, vector_type


@dataclass(frozen=True)
class HashGridLayout:
    """Sizes of the levels of a hash grid and where each lies in the common table."""

    num_levels: int
    features_per_level: int
    """1 to 8."""
    coarsest_resolution: int
    """Cells a side of the first level."""
    finest_resolution: int
    """Cells a side of the last level; those between grow geometrically."""
    log2_rows_per_level: int
    """Upper bound of a level's rows, as a power of two."""

    @cached_property
    def levels(self) -> Int[Tensor, "L 3"]:
        """Cells a side, first row and number of rows of each level (int32)."""
        growth = (self.finest_resolution / self.coarsest_resolution) ** (1 / max(self.num_levels - 1, 1))
        rows, first = [], 0
        for level in range(self.num_levels):
            resolution = int(self.coarsest_resolution * growth**level + 1e-6)
            num_rows = min((resolution + 1) ** 3, 2**self.log2_rows_per_level)
            rows.append((resolution, first, num_rows))
            first += num_rows
        return torch.tensor(rows, dtype=torch.int32)

    @cached_property
    def num_rows(self) -> int:
        """Rows of the table over all levels."""
        return int(self.levels[-1, 1] + self.levels[-1, 2])


def hash_encode(
    positions: Float[Tensor, "S 3"],
    table: Float[Tensor, "R F"],
    layout: HashGridLayout,
    known: Float[Tensor, "S LF"] | None = None,
) -> Float[Tensor, "S LF"]:
    """Interpolated features of every level, concatenated; differentiable once in both tensors.

    Args:
        positions: Points in [0, 1]^3; a point outside takes the extension of the nearest cell.
        table: Features at the vertices, rows laid out as `layout.levels` says.
        layout: The grid's sizes.
        known: The encoding of these positions, where it was computed before from the same table: it is taken as it
            is, and only gradients are computed.
    Returns:
        Level after level of `features_per_level` features.
    Raises:
        ValueError: the table's shape isn't the layout's.
    """
    expected = (layout.num_rows, layout.features_per_level)
    if tuple(table.shape) != expected:
        raise ValueError(f"table must have shape {expected} for this layout; got {tuple(table.shape)}")
    return _HashEncode.apply(positions.contiguous(), table.contiguous(), layout, known)  # type: ignore[no-any-return]


def hash_encode_twin(
    positions: Float[Tensor, "S 3"], table: Float[Tensor, "R F"], layout: HashGridLayout
) -> Float[Tensor, "S LF"]:
    """The same as `hash_encode` in plain PyTorch: the readable definition, checked against the kernel."""
    encoded = []
    offsets = torch.tensor([[k & 1, (k >> 1) & 1, k >> 2] for k in range(8)], device=positions.device)
    for resolution, first_row, num_rows in layout.levels.tolist():
        scaled = positions * resolution
        corner = scaled.detach().floor().clamp(0, resolution - 1)
        fraction = (scaled - corner)[:, None, :]
        weights = torch.where(offsets == 1, fraction, 1 - fraction).prod(dim=-1)
        vertices = corner.long()[:, None, :] + offsets
        x, y, z = vertices.unbind(-1)
        if (resolution + 1) ** 3 <= num_rows:
            rows = x + (resolution + 1) * (y + (resolution + 1) * z)
        else:
            rows = (x ^ (y * 2654435761) ^ (z * 805459861)) % num_rows
        encoded.append((table[first_row + rows] * weights[..., None]).sum(dim=1))
    return torch.cat(encoded, dim=-1)


@cache
def _levels_on(layout: HashGridLayout, device: torch.device) -> Int[Tensor, "L 3"]:
    """The layout's levels where the kernels read them: copied there once, not at each call."""
    return layout.levels.to(device)


@cache
def _vectors(positions: torch.dtype, table: torch.dtype, width: int) -> tuple[Any, Any]:
    """Warp's types of a position and of the features of a level; the kernels are declared for them."""
    point, features = vector_type(3, positions), vector_type(width, table)
    points, rows, levels, encoded = (point, 1), (features, 1), (wp.int32, 2), (features, 2)
    declare(_encode_kernel, points, rows, levels, encoded)
    declare(_table_gradient_kernel, points, encoded, levels, rows)
    declare(_position_gradient_kernel, points, rows, encoded, levels, points)
    return point, features


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, layout: HashGridLayout, known: Tensor | None
    ) -> Tensor:
        levels = _levels_on(layout, positions.device)
        ctx.width = layout.features_per_level
        ctx.save_for_backward(positions, table, levels)
        if known is not None:
            return known.view_as(known)
        num_samples, num_levels = len(positions), layout.num_levels
        encoded = positions.new_empty(num_samples, num_levels * ctx.width)
        point, features = _vectors(positions.dtype, table.dtype, ctx.width)
        rows = encoded.view(num_samples, num_levels, ctx.width)
        arrays = [as_warp(positions, point), as_warp(table, features), levels, as_warp(rows, features)]
        launch(_encode_kernel, num_samples * num_levels, arrays, positions.device)
        return encoded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        positions, table, levels = ctx.saved_tensors
        num_samples, num_levels = len(positions), len(levels)
        point, features = _vectors(positions.dtype, table.dtype, ctx.width)
        incoming = as_warp(gradients[0].contiguous().view(num_samples, num_levels, ctx.width), features)
        table_gradient = position_gradient = None
        if ctx.needs_input_grad[1]:
            table_gradient = torch.zeros_like(table)
            arrays = [as_warp(positions, point), incoming, levels, as_warp(table_gradient, features)]
            size = num_samples * num_levels
            launch(_table_gradient_kernel, size, arrays, positions.device, cpu_part=num_samples)
        if ctx.needs_input_grad[0]:
            position_gradient = torch.empty_like(positions)
            arrays = [as_warp(positions, point), as_warp(table, features), incoming, levels]
            arrays.append(as_warp(position_gradient, point))
            launch(_position_gradient_kernel, num_samples, arrays, positions.device)
        return position_gradient, table_gradient, None, None


_PRIME_Y = wp.constant(wp.uint32(2654435761))
_PRIME_Z = wp.constant(wp.uint32(805459861))
_NO_SIGN = wp.constant(wp.uint32(0x7FFFFFFF))
_ONE = wp.constant(wp.uint32(1))


@wp.struct
@no_type_check
class _Level:
    """One level of the grid; a vertex' _row is a sum (dense) or a hash of its x and its y and z times the factors."""

    resolution: int
    first_row: int
    num_rows: int
    is_dense: bool
    factor_y: wp.uint32
    factor_z: wp.uint32
    mask: wp.uint32


@wp.func
@no_type_check
def _level_at(levels: wp.array2d(dtype=int), index: int):
    level = _Level()
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
def _cell_at(coordinate: Any, resolution: int):
    # The last cell also takes the far face; a point outside the unit cube gets its nearest cell's extension. Rounding
    # towards 0 instead of down differs only below 0, where the cell is 0 either way.
    return wp.clamp(int(coordinate), 0, resolution - 1)


@wp.func
@no_type_check
def _locate(position: Any, level: _Level):
    """The cell that a position lies in, and where in it as a part of the cell's edge."""
    point = position * type(position[0])(level.resolution)
    x = _cell_at(point[0], level.resolution)
    y = _cell_at(point[1], level.resolution)
    z = _cell_at(point[2], level.resolution)
    u = point[0] - type(point[0])(x)
    v = point[1] - type(point[0])(y)
    w = point[2] - type(point[0])(z)
    return x, y, z, u, v, w


@wp.func
@no_type_check
def _row(x: wp.uint32, y: wp.uint32, z: wp.uint32, level: _Level):
    if level.is_dense:
        return int((x + y + z) & _NO_SIGN)
    return int((x ^ y ^ z) & level.mask)


@wp.func
@no_type_check
def _rows_of_cell(x: int, y: int, z: int, level: _Level):
    """Rows of a cell's vertices within the level; x changes fastest, then y."""
    x0 = wp.uint32(x)
    y0 = wp.uint32(y) * level.factor_y
    z0 = wp.uint32(z) * level.factor_z
    x1 = x0 + _ONE
    y1 = y0 + level.factor_y
    z1 = z0 + level.factor_z
    return (
        _row(x0, y0, z0, level),
        _row(x1, y0, z0, level),
        _row(x0, y1, z0, level),
        _row(x1, y1, z0, level),
        _row(x0, y0, z1, level),
        _row(x1, y0, z1, level),
        _row(x0, y1, z1, level),
        _row(x1, y1, z1, level),
    )


@wp.func
@no_type_check
def _between(low: Any, high: Any, fraction: Any):
    return low + (high - low) * fraction


@wp.func
@no_type_check
def _add_along_x(rows: wp.array(dtype=Any), low: int, high: int, gradient: Any, fraction: Any):
    upper = gradient * fraction
    wp.atomic_add(rows, low, gradient - upper)
    wp.atomic_add(rows, high, upper)


@wp.kernel(enable_backward=False)
@no_type_check
def _encode_kernel(
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
        level = _level_at(levels, index)
        rows = table[level.first_row : level.first_row + level.num_rows]
        while sample < stop:
            x, y, z, u, v, w = _locate(positions[sample], level)
            a, b, c, d, e, f, g, h = _rows_of_cell(x, y, z, level)
            near = _between(_between(rows[a], rows[b], u), _between(rows[c], rows[d], u), v)
            far = _between(_between(rows[e], rows[f], u), _between(rows[g], rows[h], u), v)
            encoded[sample, index] = _between(near, far, w)
            sample += stride
        item = index * num_samples + sample


@wp.kernel(enable_backward=False)
@no_type_check
def _table_gradient_kernel(
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
        level = _level_at(levels, index)
        rows = table_gradient[level.first_row : level.first_row + level.num_rows]
        while sample < stop:
            x, y, z, u, v, w = _locate(positions[sample], level)
            a, b, c, d, e, f, g, h = _rows_of_cell(x, y, z, level)
            gradient = encoded_gradient[sample, index]
            far = gradient * w
            near = gradient - far
            far_high = far * v
            near_high = near * v
            _add_along_x(rows, a, b, near - near_high, u)
            _add_along_x(rows, c, d, near_high, u)
            _add_along_x(rows, e, f, far - far_high, u)
            _add_along_x(rows, g, h, far_high, u)
            sample += stride
        item = index * num_samples + sample


@wp.kernel(enable_backward=False)
@no_type_check
def _position_gradient_kernel(
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
            level = _level_at(levels, index)
            rows = table[level.first_row : level.first_row + level.num_rows]
            x, y, z, u, v, w = _locate(positions[sample], level)
            a, b, c, d, e, f, g, h = _rows_of_cell(x, y, z, level)
            along_x = _between(
                _between(rows[b] - rows[a], rows[d] - rows[c], v),
                _between(rows[f] - rows[e], rows[h] - rows[g], v),
                w,
            )
            near_low = _between(rows[a], rows[b], u)
            near_high = _between(rows[c], rows[d], u)
            far_low = _between(rows[e], rows[f], u)
            far_high = _between(rows[g], rows[h], u)
            along_y = _between(near_high - near_low, far_high - far_low, w)
            along_z = _between(far_low - near_low, far_high - near_high, v)
            incoming = encoded_gradient[sample, index] * type(total[0])(level.resolution)
            total += type(total)(
                wp.dot(along_x, incoming), wp.dot(along_y, incoming), wp.dot(along_z, incoming)
            )
        position_gradient[sample] = total
        sample += stride
