"""Multiresolution hash encoding of positions in the unit cube.

Notation: `S` samples, `L` levels, `F` features a level, `R` rows of the table over all levels. A level of n cells a
side has (n + 1)^3 vertices; where they fit, the level is a dense grid, else its vertices share rows through a hash.

Source: Mueller et al. 2022, Instant Neural Graphics Primitives, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.operators.launching import as_warp, launch, vector_type


@dataclass(frozen=True)
class HashGridLayout:
    """Sizes of the levels of a hash grid and where each lies in the common table."""

    num_levels: int = 8
    features_per_level: int = 4
    coarsest_resolution: int = 16
    """Cells a side of the first level."""
    finest_resolution: int = 256
    """Cells a side of the last level; those between grow geometrically."""
    log2_rows_per_level: int = 17
    """Upper bound of a level's rows, as a power of two."""

    def __post_init__(self) -> None:
        if self.num_levels < 1 or not 1 <= self.features_per_level <= 8:
            raise ValueError(
                "a hash grid needs at least 1 level and 1 to 8 features a level; "
                f"got {self.num_levels} and {self.features_per_level}"
            )
        if not 1 <= self.coarsest_resolution <= self.finest_resolution <= 2**20:
            raise ValueError(
                "resolutions must satisfy 1 <= coarsest <= finest <= 2^20; "
                f"got {self.coarsest_resolution} and {self.finest_resolution}"
            )
        if not 4 <= self.log2_rows_per_level <= 24:
            raise ValueError(f"log2_rows_per_level must be 4 to 24; got {self.log2_rows_per_level}")

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
    _check_table(table, layout)
    return _HashEncode.apply(positions.contiguous(), table.contiguous(), layout, known)  # type: ignore[no-any-return]


def hash_encode_twin(
    positions: Float[Tensor, "S 3"], table: Float[Tensor, "R F"], layout: HashGridLayout
) -> Float[Tensor, "S LF"]:
    """The same as `hash_encode` in plain PyTorch: the readable definition, checked against the kernel."""
    _check_table(table, layout)
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


def _check_table(table: Tensor, layout: HashGridLayout) -> None:
    expected = (layout.num_rows, layout.features_per_level)
    if tuple(table.shape) != expected:
        raise ValueError(f"table must have shape {expected} for this layout; got {tuple(table.shape)}")


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, layout: HashGridLayout, known: Tensor | None
    ) -> Tensor:
        from unmix_plugin.operators._hash_kernels import encode_kernel

        levels = _levels_on(layout, positions.device)
        ctx.width = layout.features_per_level
        ctx.save_for_backward(positions, table, levels)
        if known is not None:
            return known.view_as(known)
        num_samples, num_levels = len(positions), layout.num_levels
        encoded = positions.new_empty(num_samples, num_levels * ctx.width)
        point, features = vector_type(3, positions.dtype), vector_type(ctx.width, table.dtype)
        rows = encoded.view(num_samples, num_levels, ctx.width)
        arrays = [
            as_warp(positions, point),
            as_warp(table, features),
            as_warp(levels),
            as_warp(rows, features),
        ]
        launch(encode_kernel, num_samples * num_levels, arrays, positions.device)
        return encoded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        from unmix_plugin.operators._hash_kernels import position_gradient_kernel, table_gradient_kernel

        positions, table, levels = ctx.saved_tensors
        num_samples, num_levels = len(positions), len(levels)
        point, features = vector_type(3, positions.dtype), vector_type(ctx.width, table.dtype)
        incoming = as_warp(gradients[0].contiguous().view(num_samples, num_levels, ctx.width), features)
        table_gradient = position_gradient = None
        if ctx.needs_input_grad[1]:
            table_gradient = torch.zeros_like(table)
            arrays = [as_warp(positions, point), incoming, as_warp(levels), as_warp(table_gradient, features)]
            size = num_samples * num_levels
            launch(table_gradient_kernel, size, arrays, positions.device, cpu_part=num_samples)
        if ctx.needs_input_grad[0]:
            position_gradient = torch.empty_like(positions)
            arrays = [as_warp(positions, point), as_warp(table, features), incoming, as_warp(levels)]
            arrays.append(as_warp(position_gradient, point))
            launch(position_gradient_kernel, num_samples, arrays, positions.device)
        return position_gradient, table_gradient, None, None
