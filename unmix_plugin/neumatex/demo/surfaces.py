"""The built-in object: its mesh, layered materials in regions, and measured materials that mix smoothly.

It is the first of the objects that tools/procedural_objects.py makes of seeds, of other shapes and materials too.

Notation: `N` positions or points, `F` waves of a noise, `R` samples along the longest edge of the bounding cube, `K`
materials, `B` bands, `P` parameters of the family.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.tracing.families import LayeredFamily, SpectralFamily
from unmix_plugin.neumatex.tracing.mesh import Mesh, mesh_of
from unmix_plugin.scenes.demo.shading import MATERIALS, reflectances

_HALF_EDGE = 1.4
"""Of the cube that is sampled."""
_NUM_KINDS = 7
"""Of materials, of which an object has three."""
_NUM_MATERIALS = 4
_ROUNDS = 30
Field: TypeAlias = Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, " N"]]
"""About the distance to a surface, negative inside."""


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


def demo_mesh(resolution: int = 96) -> Mesh:
    """The shape of the built-in object, in model space; R is `resolution`."""
    rng = np.random.default_rng([1, 0])
    return meshed(blob(rng), resolution)


def blob(rng: np.random.Generator) -> Field:
    """A ball with bumps."""
    broad, fine = Noise.draw(rng, 3.0), Noise.draw(rng, 9.0)
    return lambda p: np.linalg.norm(p, axis=-1) - 0.8 - 0.09 * noise_at(broad, p) - 0.02 * noise_at(fine, p)


def meshed(field: Field, resolution: int) -> Mesh:
    """The zero level by marching cubes of R samples per edge, with normals by the field's gradient; in model space."""
    from skimage.measure import marching_cubes

    axis = np.linspace(-_HALF_EDGE, _HALF_EDGE, resolution)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = field(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    spacing = axis[1] - axis[0]
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(spacing,) * 3, allow_degenerate=False)
    vertices = vertices.astype(np.float64) - _HALF_EDGE
    normals = torch.tensor(_gradient(field, vertices, spacing))
    mesh = mesh_of(torch.tensor(vertices), torch.tensor(np.ascontiguousarray(faces, np.int64)), normals)
    return mesh.transformed(*mesh.to_model_space())


def _gradient(field: Field, points: np.ndarray, spacing: float) -> np.ndarray:
    """Unit gradients by central differences over a part of a cell."""
    step = 0.3 * spacing
    offsets = step * np.eye(3)
    gradient = np.stack([field(points + offset) - field(points - offset) for offset in offsets], axis=-1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)


def noise_at(noise: Noise, points: np.ndarray) -> np.ndarray:
    """Values of a noise as NumPy has them."""
    return noise.at(torch.from_numpy(points).float()).numpy()


@dataclass(frozen=True)
class Pattern:
    """A material that changes back and forth between two sets of parameters."""

    noise: Noise
    first: Float[Tensor, " P"]
    second: Float[Tensor, " P"]
    sharpness: float
    """Small is smooth, large is two-coloured."""
    stripes: float = 0.0
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
    """Materials in regions."""

    def __init__(
        self, kinds: Mapping[str, Callable[[np.random.Generator], Pattern]], rng: np.random.Generator
    ) -> None:
        """Each kind of material in a region of its own."""
        self.kinds = tuple(kinds)
        self._patterns = [make(rng) for make in kinds.values()]
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


def layered_parameters(values: Mapping[str, float], colour: np.ndarray) -> Tensor:
    """Parameters by name; those not named are 0, the specular level 0.5."""
    named = {"specular level": 0.5, **values}
    scalars = [named.pop(name, 0.0) for name in LayeredFamily.PARAMETERS[3:]]
    if named:
        raise ValueError(f"no parameters of layered materials: {', '.join(named)}")
    return torch.tensor([*colour.tolist(), *scalars], dtype=torch.float32).clamp(0.0, 1.0)


def random_colour(
    rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]
) -> np.ndarray:
    """A linear colour of random hue."""
    hue, strength, brightness = rng.uniform(0, 6), rng.uniform(*saturation), rng.uniform(*value)
    wheel = np.clip(np.abs((hue + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0, 1)
    return brightness * (1 - strength * (1 - wheel))


def _car_paint(rng: np.random.Generator) -> Pattern:
    colour = random_colour(rng, (0.6, 0.95), (0.3, 0.8))
    coat = {"coat weight": rng.uniform(0.8, 1.0), "coat roughness": rng.uniform(0.05, 0.2)}
    base = {"metallicity": rng.uniform(0.5, 0.9), "roughness": rng.uniform(0.4, 0.6)}
    second = base | {"roughness": base["roughness"] - 0.12}
    return Pattern(
        Noise.draw(rng, 5.0),
        layered_parameters(base | coat, colour),
        layered_parameters(second | coat, colour * rng.uniform(0.55, 0.8)),
        sharpness=1.5,
    )


def _velvet(rng: np.random.Generator) -> Pattern:
    first, second = (random_colour(rng, (0.5, 0.9), (0.12, 0.5)) for _ in range(2))
    fuzz = {"sheen weight": rng.uniform(0.6, 1.0), "sheen roughness": rng.uniform(0.25, 0.6)}
    cloth = {
        "roughness": rng.uniform(0.75, 0.95),
        "specular level": 0.25,
        "sheen tint": rng.uniform(0.0, 0.8),
    }
    return Pattern(
        Noise.draw(rng, rng.uniform(4, 8)),
        layered_parameters(fuzz | cloth, first),
        layered_parameters(fuzz | cloth, second),
        sharpness=9.0,
    )


def _coated_wood(rng: np.random.Generator) -> Pattern:
    dark = np.array([0.22, 0.10, 0.045]) * rng.uniform(0.6, 1.5)
    light = np.array([0.55, 0.32, 0.16]) * rng.uniform(0.8, 1.3)
    coat = {"coat weight": rng.uniform(0.7, 1.0), "coat roughness": rng.uniform(0.1, 0.35), "roughness": 0.7}
    return Pattern(
        Noise.draw(rng, 2.2, num_waves=6),
        layered_parameters(coat, dark),
        layered_parameters(coat, light),
        sharpness=2.5,
        stripes=rng.uniform(7, 11),
    )


DEMO_KINDS = {"velvet": _velvet, "car paint": _car_paint, "coated wood": _coated_wood}


def demo_surface() -> LayeredSurface:
    """The materials of the built-in object."""
    rng = np.random.default_rng([2, 0])
    # Thrown away: the kinds are fixed now, and without this draw all that follow, and so the object, would be others.
    rng.choice(_NUM_KINDS, size=len(DEMO_KINDS), replace=False)
    return LayeredSurface(DEMO_KINDS, rng)


class SpectralSurface:
    """Four of the demo scene's materials, all a function of a seed."""

    def __init__(
        self, seed: int, wavelengths_nm: Float[np.ndarray, " B"], positions: Float[Tensor, "N 3"]
    ) -> None:
        """Materials in bands with these centres, each covering about the same part of points of the surface."""
        rng = np.random.default_rng([4, seed])
        chosen = np.sort(rng.choice(len(MATERIALS), _NUM_MATERIALS, replace=False))
        self.names = tuple(MATERIALS[index] for index in chosen)
        endmembers = reflectances(wavelengths_nm)[chosen]
        self.family = SpectralFamily(torch.tensor(endmembers, dtype=torch.float32))
        self._regions = [Noise.draw(rng, rng.uniform(1.8, 3.2)) for _ in self.names]
        self._sharpness = float(np.exp(rng.uniform(np.log(4.0), np.log(16.0))))
        specular = np.stack(
            [rng.uniform(0.25, 0.7, _NUM_MATERIALS), rng.uniform(0.1, 0.3, _NUM_MATERIALS)], axis=1
        )
        self._shifts = self._balanced(positions)
        self._specular = torch.tensor(specular, dtype=torch.float32)

    def parameters(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """Parameters of `SpectralFamily` at positions of model space."""
        shares = self._shares(positions, self._shifts.to(positions))
        return torch.cat([shares, shares @ self._specular.to(shares)], dim=-1)

    def _shares(self, positions: Float[Tensor, "N 3"], shifts: Float[Tensor, " K"]) -> Float[Tensor, "N K"]:
        levels = torch.stack([region.at(positions) for region in self._regions], dim=-1)
        return torch.softmax(self._sharpness * (levels + shifts), dim=-1)

    def _balanced(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, " K"]:
        """Shifts of the levels that give every material about the same mean share."""
        shifts = torch.zeros(_NUM_MATERIALS)
        for _ in range(_ROUNDS):
            means = self._shares(positions, shifts).mean(dim=0)
            shifts = shifts - (_NUM_MATERIALS * means).clamp(min=1e-3).log() / self._sharpness
        return shifts
