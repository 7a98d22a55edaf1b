"""A surface of a few measured materials that mix smoothly, under a gloss that each material has its own of.

Notation: `N` positions, `K` materials, `B` bands, `P` parameters of `SpectralFamily`.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.demo.noise import Noise
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.scenes.demo.shading import MATERIALS, reflectances

NUM_MATERIALS = 4
_ROUNDS = 30


class SpectralSurface:
    """Four of the demo scene's materials, all a function of a seed."""

    def __init__(
        self, seed: int, wavelengths_nm: Float[np.ndarray, " B"], positions: Float[Tensor, "N 3"]
    ) -> None:
        """
        Args:
            seed: Which materials and where.
            wavelengths_nm: Band centres.
            positions: Points of the surface, of which each material covers about the same part.
        """
        rng = np.random.default_rng([4, seed])
        chosen = np.sort(rng.choice(len(MATERIALS), NUM_MATERIALS, replace=False))
        self.names = tuple(MATERIALS[index] for index in chosen)
        endmembers = reflectances(wavelengths_nm)[chosen]
        self.family = SpectralFamily(torch.tensor(endmembers, dtype=torch.float32))
        self._regions = [Noise.draw(rng, rng.uniform(1.8, 3.2)) for _ in self.names]
        self._sharpness = float(np.exp(rng.uniform(np.log(4.0), np.log(16.0))))
        gloss = np.stack(
            [rng.uniform(0.25, 0.7, NUM_MATERIALS), rng.uniform(0.1, 0.3, NUM_MATERIALS)], axis=1
        )
        self._shifts = self._balanced(positions)
        self._gloss = torch.tensor(gloss, dtype=torch.float32)

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of `SpectralFamily` at positions of model space."""
        shares = self._shares(positions, self._shifts.to(positions))
        return torch.cat([shares, shares @ self._gloss.to(shares)], dim=-1)

    def _shares(self, positions: Float[Tensor, "N 3"], shifts: Float[Tensor, " K"]) -> Float[Tensor, "N K"]:
        levels = torch.stack([region.at(positions) for region in self._regions], dim=-1)
        return torch.softmax(self._sharpness * (levels + shifts), dim=-1)

    def _balanced(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, " K"]:
        """Shifts of the levels that give every material about the same mean share."""
        shifts = torch.zeros(NUM_MATERIALS)
        for _ in range(_ROUNDS):
            means = self._shares(positions, shifts).mean(dim=0)
            shifts = shifts - (NUM_MATERIALS * means).clamp(min=1e-3).log() / self._sharpness
        return shifts
