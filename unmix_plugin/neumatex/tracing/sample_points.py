"""Random numbers of paths: uniform for each path, evenly spread over the paths of a point.

A Sobol sequence over the samples is shifted by random numbers of each point (modulo 1), so that each path's numbers
are uniform and independent between points, dimensions and calls, but fill the unit cube evenly.

Source: Cranley and Patterson 1976, Randomization of Number Theoretic Methods for Multiple Integration.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

NUMBERS_A_VERTEX = 5
"""Two for the environment, three for the material."""


@dataclass(frozen=True)
class SamplePoints:
    """Numbers in [0, 1) of N points, S samples each."""

    sequence: Float64[Tensor, "S D"]
    """Common to the points."""
    shifts: Float64[Tensor, "N D"]
    """Of each point."""

    @staticmethod
    def draw(
        num_points: int,
        samples: int,
        vertices: int,
        generator: torch.Generator | None,
        device: torch.device,
    ) -> SamplePoints:
        """Numbers for paths of so many vertices.

        Raises:
            ValueError: there is no sample.
        """
        if samples < 1:
            raise ValueError(f"samples must be at least 1; got {samples}")
        dimensions = NUMBERS_A_VERTEX * vertices
        sequence = torch.quasirandom.SobolEngine(dimensions).draw(samples, dtype=torch.float64)
        shifts = torch.rand(num_points, dimensions, generator=generator, dtype=torch.float64, device=device)
        return SamplePoints(sequence.to(device), shifts)

    def of(self, paths: Int[Tensor, " M"], vertex: int) -> Float[Tensor, "M 5"]:
        """Numbers of a vertex of paths; path p is sample p % S of point p // S."""
        samples = len(self.sequence)
        part = slice(NUMBERS_A_VERTEX * vertex, NUMBERS_A_VERTEX * (vertex + 1))
        moved = self.sequence[:, part][paths % samples] + self.shifts[:, part][paths // samples]
        # Rounding to float32 later must not reach 1.
        return (moved - moved.floor()).clamp(max=1 - 2.0**-24)
