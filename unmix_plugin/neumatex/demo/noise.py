"""Smooth random functions of position.

Notation: `N` positions, `F` waves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Noise:
    """A sum of plane waves, about normally distributed with mean 0 and variance 1 over space."""

    waves: Float[Tensor, "F 3"]
    """Angular frequencies, radians a unit."""
    phases: Float[Tensor, " F"]

    @staticmethod
    def draw(rng: np.random.Generator, frequency: float, num_waves: int = 24) -> Noise:
        """Waves of about `frequency` radians a unit, in all directions."""
        directions = rng.normal(size=(num_waves, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths = frequency * rng.uniform(0.5, 1.5, (num_waves, 1))
        phases = rng.uniform(0, 2 * np.pi, num_waves)
        return Noise(*(torch.tensor(part, dtype=torch.float32) for part in (directions * lengths, phases)))

    def at(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        """Values at positions."""
        angles = positions @ self.waves.to(positions).T + self.phases.to(positions)
        return angles.cos().sum(dim=-1) * (2 / len(self.phases)) ** 0.5
