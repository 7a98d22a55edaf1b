"""Samples along rays through an unbounded world, in the occupied cells of a grid over contracted space.

Rays start at their origins. Samples lie `step` apart within the inner cube and farther apart outside, as the contracted
cells are: `step` r up to r = 2, `step` r^2 / 2 beyond, r the maximum norm in units of the inner cube's half edge. They
end at r = 512, behind which nothing but the sky is told apart.

Every sample counts for one `step`, however long its interval: density is per unit of contracted space, and a sample
is as opaque anywhere in an untrained field.

Notation: as in marching.py; points are in units of the inner cube's half edge, centred on it.

Of the kernel a work item is a ray. From an empty point of the inner cube it goes on to the first one that may lie in an
occupied cell, by the skips of the cell: contraction lengthens no way by more than a third, in the maximum norm.
"""

from typing import no_type_check

import torch
import warp as wp
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.engine.geometry.space import contracted_unit
from unmix_plugin.operators.marching import GridRays, PackedSamples, check_step, packed_where
from unmix_plugin.operators.occupancy import cells_at

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
    return GridRays.of(_write_kernel, (origins, directions), (t_start, jitter), skips, step)


def march_contracted_twin(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_start: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    skips: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """`rays_in_world(...).samples()` in plain PyTorch: walks all rays at once."""
    check_step(step)
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
def _skip_at(point: wp.vec3f, skips: wp.array3d(dtype=wp.uint8)):
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
def _write_kernel(
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
            clear = _skip_at(origin + middle * direction, skips)
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
