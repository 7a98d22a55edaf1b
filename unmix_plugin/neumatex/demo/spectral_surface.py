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
from unmix_plugin.scenes.demo.materials import MATERIALS, reflectances

NUM_MATERIALS = 4


class SpectralSurface:
    """Four of the demo scene's materials, all a function of a seed."""

    def __init__(self, seed: int, wavelengths_nm: Float[np.ndarray, " B"]) -> None:
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
        self._gloss = torch.tensor(gloss, dtype=torch.float32)

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of `SpectralFamily` at positions of model space."""
        levels = torch.stack([region.at(positions) for region in self._regions], dim=-1)
        shares = torch.softmax(self._sharpness * levels, dim=-1)
        return torch.cat([shares, shares @ self._gloss.to(shares)], dim=-1)
