"""What a known light sends into lobes: cosine-weighted for the diffuse part, narrower ones about a mirrored direction.

Notation: `N` directions, `K` lobes, `C` colours, `H x W` pixels of a latitude-longitude picture,
`P` of a coarse one.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from unmix_plugin.neumatex.lighting.environment import Environment, directions_of_pixels

SHARPNESSES = (128.0, 20.0, 4.0)
"""Of the blurred lobes exp(k cos): about what GGX of roughness 0.25, 0.4 and 0.6 reflects."""
NUM_LOBES = 1 + len(SHARPNESSES)
"""K: the nearly unblurred light and the blurred lobes."""
_MIRROR_ROWS = 64
_BLURRED_ROWS = 32


@dataclass(frozen=True)
class LightLobes:
    """A light that was blurred once, so that lobes of it are look-ups."""

    diffuse: Environment
    """Irradiance over pi of a surface by the direction of its normal; nothing is in the way."""
    mirrored: tuple[Environment, ...]
    """Mean radiance of each lobe by its direction, sharpest first."""

    def about(self, directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N K C"]:
        """Mean radiance of each lobe about directions."""
        return torch.stack([lobe.radiance(directions) for lobe in self.mirrored], dim=1)


def light_lobes(environment: Environment) -> LightLobes:
    """Blur an environment's picture into lobes."""
    coarse = _shrunk(environment, _BLURRED_ROWS)

    def blurred(kernel: Tensor) -> Environment:
        image = kernel.to(coarse) @ coarse.flatten(0, 1)
        return Environment(image.reshape(coarse.shape), environment.rotation_deg)

    diffuse, *lobes = [blurred(kernel) for kernel in _kernels()]
    mirror = Environment(_shrunk(environment, _MIRROR_ROWS), environment.rotation_deg)
    return LightLobes(diffuse, (mirror, *lobes))


@functools.cache
def _kernels() -> list[Float[Tensor, "P P"]]:
    """Weights of every pixel's light in the lobe about every pixel, the diffuse lobe first; they belong to no light."""
    directions = directions_of_pixels(_BLURRED_ROWS, 2 * _BLURRED_ROWS).reshape(-1, 3)
    cosines = directions @ directions.T
    edges = torch.arange(_BLURRED_ROWS + 1, dtype=torch.float64) * math.pi / _BLURRED_ROWS
    areas = (edges[:-1].cos() - edges[1:].cos()).repeat_interleave(2 * _BLURRED_ROWS).to(cosines)
    shapes = [cosines.clamp(min=0), *(torch.exp(sharpness * (cosines - 1)) for sharpness in SHARPNESSES)]
    return [functional.normalize(shape * areas, p=1, dim=1) for shape in shapes]


def _shrunk(environment: Environment, rows: int) -> Float[Tensor, "H W C"]:
    """Means of an environment's radiance over larger pixels."""
    picture = (environment.image.float() * 2.0**environment.exposure_stops).permute(2, 0, 1)
    return functional.adaptive_avg_pool2d(picture, (rows, 2 * rows)).permute(1, 2, 0)
