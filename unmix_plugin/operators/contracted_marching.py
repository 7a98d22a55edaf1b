"""Samples along rays through an unbounded world, in the occupied cells of a grid over contracted space.

Rays start at their origins. Samples lie `step` apart within the inner cube and farther apart outside, as the contracted
cells are: `step` r up to r = 2, `step` r^2 / 2 beyond, r the maximum norm in units of the inner cube's half edge. They
end at r = 512, behind which nothing but the sky is told apart.

Every sample counts for one `step`, however long its interval: density is per unit of contracted space, and a sample
is as opaque anywhere in an untrained field.

Notation: as in marching.py; points are in units of the inner cube's half edge, centred on it.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.operators.grid_cells import cells_at
from unmix_plugin.operators.launching import KernelArray, as_warp, launch, vector_type
from unmix_plugin.operators.marching import (
    FirstSamples,
    PackedSamples,
    check_step,
    count_and_write,
    room_for_samples,
)

FAR_RADIUS = 512.0
LINEAR_RADIUS = 2.0


def march_contracted(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    jitter: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """Samples of each ray from its origin to r = 512, in occupied cells of contracted space.

    Args:
        origins, directions: Rays in units of the inner cube's half edge.
        jitter: Where in its interval a ray's samples lie, [0, 1).
        clearance: 0 in occupied cells of the cube from -2 to 2, whatever else it is in others.
        step: Distance of samples in the inner cube, in the ray parameter, > 0.
    Raises:
        ValueError: step isn't positive.
    """
    from unmix_plugin.operators._contracted_kernels import count_kernel, write_kernel

    rays = _rays(origins, directions, jitter, clearance, step)
    return PackedSamples(*count_and_write(count_kernel, write_kernel, rays, origins), step)


def march_contracted_first(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_start: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
    most: int,
) -> FirstSamples:
    """The first samples that `march_contracted` takes of each ray in the middles of intervals, at most `most`.

    Args:
        t_start: 0, or the `ends` of the samples before.
    """
    from unmix_plugin.operators._contracted_kernels import first_kernel

    rays = _rays(origins, directions, torch.full_like(t_start, 0.5), clearance, step)
    t, counts = room_for_samples(origins, most)
    ends = torch.empty_like(t_start)
    arrays = [as_warp(values) for values in (t_start.contiguous(), counts, ends, t)]
    launch(first_kernel, len(origins), [*rays, *arrays], origins.device)
    return FirstSamples(t, counts, ends)


def _rays(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    jitter: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> list[KernelArray | float]:
    """The arguments that all kernels share."""
    check_step(step)
    point = vector_type(3, torch.float32)
    lines = [as_warp(values.contiguous(), point) for values in (origins, directions)]
    return [*lines, as_warp(jitter.contiguous()), step, as_warp(clearance.contiguous())]


def march_contracted_twin(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    jitter: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """The same as `march_contracted` in plain PyTorch: walks all rays at once."""
    check_step(step)
    t = torch.zeros_like(jitter)
    found: list[tuple[Tensor, Tensor]] = []
    while True:
        radius = (origins + t[:, None] * directions).abs().amax(dim=-1)
        is_inside = radius <= FAR_RADIUS
        if not bool(is_inside.any()):
            break
        near = radius.clamp(min=1.0)
        stride = step * near * (near / LINEAR_RADIUS).clamp(min=1.0)
        at = t + jitter * stride
        unit = unit_points(origins + at[:, None] * directions)
        hit = is_inside & (clearance[tuple(cells_at(unit, clearance.shape).unbind(-1))] == 0)
        found.append((hit, at))
        t = torch.where(is_inside, t + stride, t)
    nothing = torch.zeros(len(origins), 0, device=origins.device)
    hit, t_samples = (
        (torch.stack(values, dim=1) for values in zip(*found, strict=True))
        if found
        else (nothing > 0, nothing)
    )
    counts = hit.sum(dim=1)
    packed_info = torch.stack([counts.cumsum(0) - counts, counts], dim=-1)
    return PackedSamples(t_samples[hit], hit.nonzero()[:, 0], packed_info, step)


def unit_points(points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """Where points of the world lie in the unit cube that the grid fills."""
    radius = points.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
    return points * ((2.0 - 1.0 / radius) / radius) / 4.0 + 0.5
