"""Materials for the training of priors: layered ones of all kinds, and how they are spread over an object.

Notation: `N` points, `M` materials of an object or noises, `P` parameters of `LayeredFamily`, `W` waves of all noises.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.materials.layered import LayeredFamily

_WAVES = 12
_INDEX = {name: index for index, name in enumerate(LayeredFamily.PARAMETERS)}


def random_materials(count: int, generator: torch.Generator) -> Float[Tensor, "M P"]:
    """Layered materials: plain ones, metals, lacquer, cloth, haze and dust, and mixtures of these."""

    def uniform(low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    def sometimes(chance: float, values: Tensor) -> Tensor:
        return torch.where(uniform() < chance, values, torch.zeros(()))

    parameters = torch.zeros(count, LayeredFamily.num_parameters)
    brightness = uniform(0.02, 0.95)[:, None]
    hue = torch.rand(count, 3, generator=generator)
    saturation = uniform()[:, None]
    parameters[:, :3] = (brightness * (1 - saturation * hue)).clamp(0.01, 0.98)
    drawn = {
        "metallicity": sometimes(0.3, torch.where(uniform() < 0.7, 1.0, uniform())),
        "roughness": uniform(0.05, 1.0),
        "specular level": torch.where(uniform() < 0.5, 0.5, uniform()),
        "coat weight": sometimes(0.3, uniform(0.3, 1.0)),
        "coat roughness": uniform(0.0, 0.6),
        "sheen weight": sometimes(0.25, uniform(0.2, 1.0)),
        "sheen roughness": uniform(0.1, 1.0),
        "sheen tint": uniform(),
        "haze weight": sometimes(0.25, uniform(0.2, 1.0)),
        "haze spread": uniform(),
        "dust": sometimes(0.2, uniform(0.1, 1.0)),
    }
    for name, values in drawn.items():
        parameters[:, _INDEX[name]] = values
    return parameters


@dataclass(frozen=True)
class SmoothNoise:
    """Sums of random waves: values of mean 0 and variance 1 at any point."""

    vectors: Float[Tensor, "3 W"]
    phases: Float[Tensor, " W"]

    @staticmethod
    def draw(count: int, scale: float, generator: torch.Generator) -> SmoothNoise:
        """M = `count` independent noises.

        Args:
            scale: Standard deviation of the wave vectors, radians a model unit.
        """
        waves = _WAVES * count
        vectors = torch.randn(3, waves, generator=generator) * scale / math.sqrt(3)
        return SmoothNoise(vectors, 2 * math.pi * torch.rand(waves, generator=generator))

    def __call__(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N M"]:
        """Values at points."""
        values = torch.sin(positions @ self.vectors + self.phases).unflatten(1, (-1, _WAVES))
        return values.sum(dim=-1) * math.sqrt(2 / _WAVES)


@dataclass(frozen=True)
class PatchedSurface:
    """Layered materials in patches, with colours and roughness that vary within each; a `Surface`."""

    family: LayeredFamily
    materials: Float[Tensor, "M P"]
    patches: SmoothNoise
    sharpness: float
    """How abrupt the edges of patches are."""
    detail: SmoothNoise
    strength: float
    """How much colours and roughness vary."""

    @staticmethod
    def draw(generator: torch.Generator) -> PatchedSurface:
        """One object's materials: one to four of them."""
        count = 1 + int(torch.randint(4, (), generator=generator))
        scale, sharpness, strength = (float(value) for value in torch.rand(3, generator=generator))
        scale = 1 + 5 * scale
        return PatchedSurface(
            LayeredFamily(),
            random_materials(count, generator),
            SmoothNoise.draw(count, scale, generator),
            2 + 38 * sharpness,
            SmoothNoise.draw(2, 3 * scale, generator),
            0.4 * strength**2,
        )

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of `LayeredFamily` at points."""
        shares = torch.softmax(self.sharpness * self.patches(positions), dim=-1)
        parameters = shares @ self.materials
        detail = self.detail(positions) * self.strength
        parameters[:, :3] = (parameters[:, :3] * torch.exp(2 * detail[:, :1])).clamp(0.01, 0.98)
        roughness = _INDEX["roughness"]
        parameters[:, roughness] = (parameters[:, roughness] + detail[:, 1]).clamp(0.03, 1.0)
        return parameters
