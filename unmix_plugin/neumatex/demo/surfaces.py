"""Surfaces of built-in objects: layered materials in regions, and measured materials that mix smoothly.

Notation: `N` positions, `K` materials, `B` bands, `P` parameters of the family.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.demo.shapes import Noise
from unmix_plugin.neumatex.tracing.families import LayeredFamily, SpectralFamily
from unmix_plugin.scenes.demo.shading import MATERIALS, reflectances

NUM_MATERIALS = 4
_ROUNDS = 30


@dataclass(frozen=True)
class _Pattern:
    """A material that changes back and forth between two sets of parameters."""

    noise: Noise
    first: Float[Tensor, " P"]
    second: Float[Tensor, " P"]
    sharpness: float
    """Small is smooth, large is two-coloured."""
    stripes: float
    """Stripes a unit of the noise; 0 for patches."""

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        values = self.noise.at(positions)
        if self.stripes:
            values = torch.sin(self.stripes * values)
        share = torch.sigmoid(self.sharpness * values)[:, None]
        return torch.lerp(
            self.first.to(positions).expand(len(positions), -1), self.second.to(positions), share
        )


class LayeredSurface:
    """Three materials in regions, all a function of a seed."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([2, seed])
        kinds = rng.choice(list(_KINDS), size=3, replace=False)
        self.kinds = tuple(str(kind) for kind in kinds)
        self._patterns = [_KINDS[kind](rng) for kind in self.kinds]
        self._regions = [Noise.draw(rng, rng.uniform(1.8, 3.2)) for _ in self.kinds]
        self._sharpness = float(np.exp(rng.uniform(np.log(8.0), np.log(60.0))))

    @property
    def family(self) -> LayeredFamily:
        """Reflectances of the parameters."""
        return LayeredFamily()

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of `LayeredFamily` at positions of model space."""
        levels = torch.stack([region.at(positions) for region in self._regions], dim=-1)
        shares = torch.softmax(self._sharpness * levels, dim=-1)
        values = torch.stack([pattern.parameters(positions) for pattern in self._patterns], dim=-1)
        return (values * shares[:, None]).sum(dim=-1).clamp(0.0, 1.0)


def _vector(values: Mapping[str, float], colour: np.ndarray) -> Tensor:
    """Parameters by name; those not named are 0, the specular level 0.5."""
    named = {"specular level": 0.5, **values}
    scalars = [named.pop(name, 0.0) for name in LayeredFamily.PARAMETERS[3:]]
    if named:
        raise ValueError(f"no parameters of layered materials: {', '.join(named)}")
    return torch.tensor([*colour.tolist(), *scalars], dtype=torch.float32).clamp(0.0, 1.0)


def _colour(
    rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]
) -> np.ndarray:
    """A linear colour of random hue."""
    hue, strength, brightness = rng.uniform(0, 6), rng.uniform(*saturation), rng.uniform(*value)
    wheel = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return brightness * (1 - strength * (1 - wheel))


def _metallic_tone(rng: np.random.Generator) -> np.ndarray:
    tones = ((0.95, 0.64, 0.37), (1.0, 0.78, 0.34), (0.91, 0.92, 0.92), (0.56, 0.57, 0.58), (0.8, 0.62, 0.5))
    return np.array(tones[rng.integers(len(tones))]) * rng.uniform(0.8, 1.0)


def _car_paint(rng: np.random.Generator) -> _Pattern:
    colour = _colour(rng, (0.6, 0.95), (0.3, 0.8))
    coat = {"coat weight": rng.uniform(0.8, 1.0), "coat roughness": rng.uniform(0.05, 0.2)}
    base = {"metallicity": rng.uniform(0.5, 0.9), "roughness": rng.uniform(0.4, 0.6)}
    second = base | {"roughness": base["roughness"] - 0.12}
    return _Pattern(
        Noise.draw(rng, 5.0),
        _vector(base | coat, colour),
        _vector(second | coat, colour * rng.uniform(0.55, 0.8)),
        sharpness=1.5,
        stripes=0.0,
    )


def _velvet(rng: np.random.Generator) -> _Pattern:
    first, second = (_colour(rng, (0.5, 0.9), (0.12, 0.5)) for _ in range(2))
    fuzz = {"sheen weight": rng.uniform(0.6, 1.0), "sheen roughness": rng.uniform(0.25, 0.6)}
    cloth = {
        "roughness": rng.uniform(0.75, 0.95),
        "specular level": 0.25,
        "sheen tint": rng.uniform(0.0, 0.8),
    }
    return _Pattern(
        Noise.draw(rng, rng.uniform(4, 8)),
        _vector(fuzz | cloth, first),
        _vector(fuzz | cloth, second),
        9.0,
        0.0,
    )


def _hazy_plastic(rng: np.random.Generator) -> _Pattern:
    first, second = _colour(rng, (0.3, 0.9), (0.4, 0.8)), _colour(rng, (0.0, 0.5), (0.3, 0.8))
    haze = {"haze weight": rng.uniform(0.5, 1.0), "haze spread": rng.uniform(0.3, 0.8), "specular level": 0.7}
    return _Pattern(
        Noise.draw(rng, rng.uniform(3, 6)),
        _vector(haze | {"roughness": rng.uniform(0.12, 0.25)}, first),
        _vector(haze | {"roughness": rng.uniform(0.25, 0.4)}, second),
        sharpness=14.0,
        stripes=rng.choice([0.0, 4.0]),
    )


def _dusty_gloss(rng: np.random.Generator) -> _Pattern:
    colour = _colour(rng, (0.3, 0.9), (0.1, 0.45))
    gloss = {
        "roughness": rng.uniform(0.12, 0.25),
        "specular level": 0.6,
        "coat weight": rng.choice([0.0, 0.8]),
    }
    return _Pattern(
        Noise.draw(rng, rng.uniform(4, 7)),
        _vector(gloss | {"dust": rng.uniform(0.0, 0.1)}, colour),
        _vector(gloss | {"dust": rng.uniform(0.6, 1.0)}, colour),
        sharpness=2.5,
        stripes=0.0,
    )


def _coated_wood(rng: np.random.Generator) -> _Pattern:
    dark = np.array([0.22, 0.10, 0.045]) * rng.uniform(0.6, 1.5)
    light = np.array([0.55, 0.32, 0.16]) * rng.uniform(0.8, 1.3)
    coat = {"coat weight": rng.uniform(0.7, 1.0), "coat roughness": rng.uniform(0.1, 0.35), "roughness": 0.7}
    return _Pattern(
        Noise.draw(rng, 2.2, num_waves=6),
        _vector(coat, dark),
        _vector(coat, light),
        sharpness=2.5,
        stripes=rng.uniform(7, 11),
    )


def _worn_metal(rng: np.random.Generator) -> _Pattern:
    tone = _metallic_tone(rng)
    return _Pattern(
        Noise.draw(rng, rng.uniform(5, 9)),
        _vector({"metallicity": 1.0, "roughness": rng.uniform(0.15, 0.3)}, tone),
        _vector({"metallicity": 1.0, "roughness": rng.uniform(0.45, 0.65)}, tone * rng.uniform(0.6, 0.9)),
        sharpness=4.0,
        stripes=0.0,
    )


def _glazed_clay(rng: np.random.Generator) -> _Pattern:
    clay, glaze = np.array([0.55, 0.27, 0.16]) * rng.uniform(0.7, 1.2), _colour(rng, (0.2, 0.8), (0.2, 0.7))
    return _Pattern(
        Noise.draw(rng, rng.uniform(2.5, 5)),
        _vector({"roughness": 0.9, "specular level": 0.3, "dust": 0.2}, clay),
        _vector({"roughness": 0.6, "coat weight": 1.0, "coat roughness": rng.uniform(0.1, 0.3)}, glaze),
        sharpness=25.0,
        stripes=0.0,
    )


_KINDS: dict[str, Callable[[np.random.Generator], _Pattern]] = {
    "car paint": _car_paint,
    "velvet": _velvet,
    "hazy plastic": _hazy_plastic,
    "dusty gloss": _dusty_gloss,
    "coated wood": _coated_wood,
    "worn metal": _worn_metal,
    "glazed clay": _glazed_clay,
}


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
