"""Samples along rays, only in the occupied cells of an occupancy grid.

Notation: `R` rays, `S` samples in all, stored packed: the samples of a ray are consecutive and `packed_info` holds
(first sample, count) a ray. Points are in the unit cube that the grid fills, `t` in the unit of the ray parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from unmix_plugin.operators.grid_cells import cells_at
from unmix_plugin.operators.launching import KernelArray, as_warp, launch, vector_type


@dataclass(frozen=True)
class PackedSamples:
    """Samples of a batch of rays, ray after ray."""

    t: Float[Tensor, "S"]
    """Ray parameter of each sample: the middle of its interval."""
    ray_indices: Int[Tensor, "S"]
    packed_info: Int[Tensor, "R 2"]
    """First sample and number of samples of each ray."""
    step: float
    """Length of every sample's interval; in contracted space of those in the inner cube."""

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, chosen: Int[Tensor, "some"]) -> PackedSamples:
        """Some samples by their places, with no regard to which belong to one ray: `packed_info` stays as it is."""
        return PackedSamples(
            self.t.index_select(0, chosen),
            self.ray_indices.index_select(0, chosen),
            self.packed_info,
            self.step,
        )

    def select(self, keep: Bool[Tensor, "S"]) -> PackedSamples:
        """Only the samples marked in `keep`, still packed."""
        kept_before = torch.cat([keep.new_zeros(1, dtype=torch.int64), keep.cumsum(0)])
        starts = kept_before[self.packed_info[:, 0]]
        ends = kept_before[self.packed_info[:, 0] + self.packed_info[:, 1]]
        packed_info = torch.stack([starts, ends - starts], dim=-1)
        kept = keep.nonzero()[:, 0]
        return PackedSamples(
            self.t.index_select(0, kept), self.ray_indices.index_select(0, kept), packed_info, self.step
        )


@dataclass(frozen=True)
class FirstSamples:
    """The first samples of rays, in rows of one length M."""

    t: Float[Tensor, "R M"]
    """Ray parameters; behind a ray's last sample anything."""
    counts: Int[Tensor, "R"]
    """Samples of each; less than M if there are no more."""
    ends: Float[Tensor, "R"]
    """From where to march on for more; anything if there are none."""


def march(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """Samples at t_near + (i + jitter) step that lie in occupied cells.

    Args:
        origins, directions: Rays in unit-cube coordinates; directions need not have unit length.
        t_near, t_far: Where each ray enters and leaves the unit cube; t_far <= t_near marks a miss.
        jitter: Offset of each ray's lattice in steps, [0, 1).
        clearance: 0 in occupied cells, as `clearance_of` says; cell (x, y, z) is [x/X, (x+1)/X] and so on.
        step: Distance of neighbouring samples in the ray parameter, > 0.
    Raises:
        ValueError: step isn't positive.
    """
    from unmix_plugin.operators._marching_kernels import count_kernel, write_kernel

    rays = _rays(origins, directions, t_near, t_far, jitter, clearance, step)
    return PackedSamples(*count_and_write(count_kernel, write_kernel, rays, origins), step)


def march_first(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
    most: int,
) -> FirstSamples:
    """The first samples that `march` takes of each ray at t_near + (i + 1/2) step, at most `most`."""
    from unmix_plugin.operators._marching_kernels import first_kernel

    rays = _rays(origins, directions, t_near, t_far, torch.full_like(t_near, 0.5), clearance, step)
    t, counts = room_for_samples(origins, most)
    launch(first_kernel, len(origins), [*rays, as_warp(counts), as_warp(t)], origins.device)
    return FirstSamples(t, counts, t[:, -1] + step / 2)


def room_for_samples(
    origins: Float[Tensor, "R 3"], most: int
) -> tuple[Float[Tensor, "R M"], Int[Tensor, "R"]]:
    """Memory for M samples of each ray, and for how many each has."""
    device = origins.device
    t = torch.empty(len(origins), most, dtype=torch.float32, device=device)
    return t, torch.empty(len(origins), dtype=torch.int64, device=device)


def count_samples(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> Int[Tensor, "R"]:
    """How many samples of each ray `march` takes at t_near + (i + 1/2) step."""
    from unmix_plugin.operators._marching_kernels import count_kernel

    rays = _rays(origins, directions, t_near, t_far, torch.full_like(t_near, 0.5), clearance, step)
    counts = torch.empty(len(origins), dtype=torch.int64, device=origins.device)
    launch(count_kernel, len(origins), [*rays, as_warp(counts)], origins.device)
    return counts


def _rays(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> list[KernelArray | float]:
    """The arguments that both kernels share."""
    check_step(step)
    point = vector_type(3, torch.float32)
    lines = [as_warp(values.contiguous(), point) for values in (origins, directions)]
    numbers = [as_warp(values.contiguous()) for values in (t_near, t_far, jitter)]
    return [*lines, *numbers, step, as_warp(clearance.contiguous())]


def count_and_write(
    count_kernel: Any,
    write_kernel: Any,
    rays: Sequence[KernelArray | float],
    origins: Float[Tensor, "R 3"],
) -> tuple[Float[Tensor, "S"], Int[Tensor, "S"], Int[Tensor, "R 2"]]:
    """Samples of rays by two launches: one counts them, the other writes them where there is then room.

    Args:
        rays: Arguments of both kernels.
        origins: Of the rays.
    Returns:
        Distances and rays of the samples, and each ray's first sample and number of samples.
    """
    num_rays, device = len(origins), origins.device
    counts = torch.empty(num_rays, dtype=torch.int64, device=device)
    launch(count_kernel, num_rays, [*rays, as_warp(counts)], device)
    ends = counts.cumsum(0)
    packed_info = torch.stack([ends - counts, counts], dim=-1)
    total = int(ends[-1]) if len(ends) else 0
    t_samples = torch.empty(total, dtype=torch.float32, device=device)
    ray_indices = torch.empty(total, dtype=torch.int64, device=device)
    if total:
        written = [as_warp(packed_info), as_warp(ray_indices), as_warp(t_samples)]
        launch(write_kernel, num_rays, [*rays, *written], device)
    return t_samples, ray_indices, packed_info


def march_twin(
    origins: Float[Tensor, "R 3"],
    directions: Float[Tensor, "R 3"],
    t_near: Float[Tensor, "R"],
    t_far: Float[Tensor, "R"],
    jitter: Float[Tensor, "R"],
    clearance: UInt8[Tensor, "X Y Z"],
    step: float,
) -> PackedSamples:
    """The same as `march` in plain PyTorch: tests every lattice point of every ray."""
    check_step(step)
    t_first = t_near + jitter * step
    longest = float((t_far - t_first).max()) if len(t_far) else 0.0
    index = torch.arange(max(int(longest / step) + 2, 1), device=origins.device)
    t = t_first[:, None] + index * step
    points = origins[:, None] + t[..., None] * directions[:, None]
    cells = cells_at(points, clearance.shape)
    hit = (t < t_far[:, None]) & (clearance[tuple(cells.unbind(-1))] == 0)
    counts = hit.sum(dim=1)
    starts = counts.cumsum(0) - counts
    ray_indices, _ = hit.nonzero(as_tuple=True)
    return PackedSamples(t[hit], ray_indices, torch.stack([starts, counts], dim=-1), step)


def check_step(step: float) -> None:
    """Refuse a distance of samples that isn't positive."""
    if not step > 0:
        raise ValueError(f"step must be positive; got {step}")
