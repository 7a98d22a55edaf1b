"""Procedural meshes: zero levels of smooth random functions, closed and without holes in the surface.

Notation: `N` points, `F` waves of a noise, `R` samples along the longest edge of the bounding cube.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.neumatex.tracing.mesh import Mesh, mesh_of

Field: TypeAlias = Callable[[Float[np.ndarray, "N 3"]], Float[np.ndarray, " N"]]
"""About the distance to a surface, negative inside."""
_HALF_EDGE = 1.4
"""Of the cube that is sampled."""


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


def demo_mesh(seed: int, resolution: int = 96) -> Mesh:
    """A shape of one of `SHAPES`, chosen and varied by the seed, in model space.

    Args:
        resolution: R, from which the number of triangles follows, some tens of thousands by default.
    """
    rng = np.random.default_rng([1, seed])
    make = _MAKERS[SHAPES[seed % len(SHAPES)]]
    mesh = _meshed(make(rng), resolution)
    return mesh.transformed(*mesh.to_model_space())


def _meshed(field: Field, resolution: int) -> Mesh:
    """The zero level by marching cubes, with normals by the field's gradient."""
    from skimage.measure import marching_cubes

    axis = np.linspace(-_HALF_EDGE, _HALF_EDGE, resolution)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = field(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    spacing = axis[1] - axis[0]
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(spacing,) * 3, allow_degenerate=False)
    vertices = vertices.astype(np.float64) - _HALF_EDGE
    faces = _largest_volume_outwards(vertices, faces.astype(np.int64))
    return mesh_of(
        torch.tensor(vertices), torch.tensor(faces), torch.tensor(_gradient(field, vertices, spacing))
    )


def _largest_volume_outwards(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c))
    return faces if volume > 0 else faces[:, ::-1].copy()


def _gradient(field: Field, points: np.ndarray, spacing: float) -> np.ndarray:
    """Unit gradients by central differences over a part of a cell."""
    step = 0.3 * spacing
    offsets = step * np.eye(3)
    gradient = np.stack([field(points + offset) - field(points - offset) for offset in offsets], axis=-1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-12)


def _turned(field: Field, rng: np.random.Generator) -> Field:
    """The same shape in a random orientation."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return lambda p: field(p @ rotation)


def _sphere(rng: np.random.Generator) -> Field:
    noise, depth = Noise.draw(rng, 14.0), rng.uniform(0.0, 0.012)
    return lambda p: np.linalg.norm(p, axis=-1) - 1.0 - depth * _noise_at(noise, p)


def _torus(rng: np.random.Generator) -> Field:
    thickness = rng.uniform(0.22, 0.4)
    flat = rng.uniform(0.8, 1.2)

    def _field(p: np.ndarray) -> np.ndarray:
        ring = np.hypot(p[:, 0], p[:, 1]) - (1.0 - thickness)
        return np.hypot(ring, p[:, 2] * flat) - thickness

    return _turned(_field, rng)


def _superquadric(rng: np.random.Generator) -> Field:
    around, along = rng.uniform(1.4, 5.0, 2)
    axes = rng.uniform(0.6, 1.0, 3)

    def _field(p: np.ndarray) -> np.ndarray:
        x, y, z = np.abs(p / axes).T + 1e-9
        flat = (x**around + y**around) ** (1 / around)
        return ((flat**along + z**along) ** (1 / along) - 1.0) * axes.min()

    return _turned(_field, rng)


def _blob(rng: np.random.Generator) -> Field:
    broad, fine = Noise.draw(rng, 3.0), Noise.draw(rng, 9.0)
    return lambda p: np.linalg.norm(p, axis=-1) - 0.8 - 0.09 * _noise_at(broad, p) - 0.02 * _noise_at(fine, p)


def _vase(rng: np.random.Generator) -> Field:
    """Turned on a lathe, hollow and open at the top."""
    from scipy.interpolate import CubicSpline

    heights = np.linspace(-1.3, 1.3, 7)
    profile = CubicSpline(heights, rng.uniform(0.38, 0.72, 7))
    wall = rng.uniform(0.10, 0.14)

    def _field(p: np.ndarray) -> np.ndarray:
        radius, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
        outside = np.maximum(0.8 * (radius - profile(z)), np.abs(z) - 1.0)
        cavity = np.maximum(0.8 * (radius - profile(z) + wall / 0.8), -0.75 - z)
        return _smooth_max(outside, -cavity, 0.04)

    return _field


def _parts(rng: np.random.Generator) -> Field:
    """Three to five primitives that melt into each other where they touch."""
    parts = [_part(rng) for _ in range(rng.integers(3, 6))]

    def _field(p: np.ndarray) -> np.ndarray:
        values = parts[0](p)
        for part in parts[1:]:
            values = -_smooth_max(-values, -part(p), 0.08)
        # All parts reach a ball in the middle, which joins them.
        return -_smooth_max(-values, 0.38 - np.linalg.norm(p, axis=-1), 0.08)

    return _field


def _part(rng: np.random.Generator) -> Field:
    centre = rng.normal(size=3)
    centre *= rng.uniform(0.25, 0.5) / np.linalg.norm(centre)
    size = rng.uniform(0.25, 0.45)
    kind = rng.integers(3)
    if kind == 0:
        return lambda p: np.linalg.norm(p - centre, axis=-1) - size
    if kind == 1:
        box = size * rng.uniform(0.6, 1.1, 3)
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        return lambda p: _box(np.abs((p - centre) @ rotation), box)
    return _bar(centre, rng.normal(size=3), size)


def _box(p: np.ndarray, half_edges: np.ndarray) -> np.ndarray:
    """A box with rounded edges, for points of one octant."""
    beyond = p - (half_edges - 0.06)
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0) - 0.06


def _bar(centre: np.ndarray, direction: np.ndarray, size: float) -> Field:
    """A rod with round ends through the middle of the shape."""
    direction = direction / np.linalg.norm(direction)

    def _field(p: np.ndarray) -> np.ndarray:
        along = np.clip((p - centre) @ direction, -0.6, 0.6)
        return np.linalg.norm(p - centre - along[:, None] * direction, axis=-1) - 0.45 * size

    return _field


def _smooth_max(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The greater of two numbers, rounded where they differ by less than about `width`."""
    return (a + b + np.sqrt((a - b) ** 2 + width**2)) / 2


def _noise_at(noise: Noise, points: np.ndarray) -> np.ndarray:
    return noise.at(torch.from_numpy(points).float()).numpy()


_MAKERS: dict[str, Callable[[np.random.Generator], Field]] = {
    "blob": _blob,
    "vase": _vase,
    "parts": _parts,
    "torus": _torus,
    "superquadric": _superquadric,
    "sphere": _sphere,
}

SHAPES = tuple(_MAKERS)
"""In the order of seeds."""
