"""Drawing pixels of a picture in proportion to weights, by inverting the distribution of rows, then of columns.

Numbers that lie close together lead to places that do: evenly spread numbers give evenly spread places.

Notation: `H x W` pixels, `N` draws.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor


@dataclass(frozen=True)
class PictureInversion:
    """Cumulative shares of a picture's pixels."""

    rows: Float64[Tensor, " row_edges"]
    """Share of all rows before each, from 0 to 1."""
    columns: Float64[Tensor, "H column_edges"]
    """In each row, the share of all pixels before each."""
    ends: Float64[Tensor, " HW"]
    """Share up to and with each pixel of its row, plus the row's index: one increasing list."""

    @staticmethod
    def of(weights: Float[Tensor, "H W"]) -> PictureInversion:
        """For weights of at least 0, not all of them 0."""
        weights = weights.double()
        rows, columns = _cumulative(weights.sum(dim=1)), _cumulative(weights)
        indices = torch.arange(len(weights), dtype=torch.float64, device=weights.device)
        return PictureInversion(rows, columns, (columns[:, 1:] + indices[:, None]).reshape(-1))

    def draw(
        self, uniforms: Float[Tensor, "N 2"]
    ) -> tuple[Int[Tensor, " N"], Int[Tensor, " N"], Float64[Tensor, " N"], Float64[Tensor, " N"]]:
        """Pixels and places within them.

        Args:
            uniforms: For the row and the column, in [0, 1).
        Returns:
            Row, column, and how far down and across in the pixel, in [0, 1].
        """
        for_row, for_column = uniforms.double().T.contiguous()
        width = self.columns.shape[1] - 1
        row = torch.searchsorted(self.rows, for_row, right=True).clamp(1, len(self.rows) - 1) - 1
        column = torch.searchsorted(self.ends, for_column + row, right=True) - row * width
        column = column.clamp(0, width - 1)
        down = _within(for_row, self.rows[row], self.rows[row + 1])
        across = _within(for_column, self.columns[row, column], self.columns[row, column + 1])
        return row, column, down, across


def _cumulative(weights: Float64[Tensor, "*rows n"]) -> Float64[Tensor, "*rows n+1"]:
    """Shares before each item; even ones where all weights are 0."""
    weights = torch.where(weights.sum(dim=-1, keepdim=True) > 0, weights, 1.0)
    sums = weights.cumsum(dim=-1)
    return torch.cat([torch.zeros_like(sums[..., :1]), sums / sums[..., -1:]], dim=-1)


def _within(value: Tensor, low: Tensor, high: Tensor) -> Float64[Tensor, " N"]:
    return ((value - low) / (high - low).clamp(min=1e-300)).clamp(0.0, 1.0)
