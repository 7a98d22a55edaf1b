"""Bodies of path-traced scenes: meshes whose vertices know the abundances of their materials.

Notation: `V` vertices, `K` materials. Lengths are in scene units, z points upwards. Patterns are functions of a place,
so that a mesh may be as fine as it needs to be; abundances are >= 0 and sum to 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

Array = np.ndarray
Pattern = Callable[[Array], Array]
"""From places (V, 3) to the abundances of some materials there (V, M)."""
_FREQUENCIES = 24
"""Waves in a random field."""


@dataclass(frozen=True)
class Body:
    """A surface with known abundances."""

    mesh: trimesh.Trimesh
    abundances: Array
    """(V, K)."""
    roughness: float | None = None
    """Of the clear coat, whose highlights have the colour of the light; None is matt."""

    @staticmethod
    def of(
        mesh: trimesh.Trimesh,
        materials: Sequence[int],
        pattern: Pattern,
        count: int,
        roughness: float | None = None,
    ) -> Body:
        """A mesh on which a pattern distributes the given of `count` materials."""
        abundances = np.zeros((len(mesh.vertices), count))
        abundances[:, list(materials)] = pattern(np.asarray(mesh.vertices))
        return Body(mesh, abundances, roughness)


# Patterns


def plain(places: Array) -> Array:
    """One material everywhere."""
    return np.ones((len(places), 1))


def random_field(rng: np.random.Generator, size: float) -> Callable[[Array], Array]:
    """A smooth function of the place, of about unit variance, whose features are `size` wide."""
    waves = rng.standard_normal((3, _FREQUENCIES)) * (2.0 / size)
    phases = rng.uniform(0, 2 * np.pi, _FREQUENCIES)
    return lambda places: np.cos(places @ waves + phases).sum(axis=1) * np.sqrt(2.0 / _FREQUENCIES)


def mottled(rng: np.random.Generator, count: int, size: float, sharpness: float = 4.0) -> Pattern:
    """Patches of `count` materials that run into each other: the sharper, the narrower the border."""
    fields = [random_field(rng, size) for _ in range(count)]

    def pattern(places: Array) -> Array:
        weights = np.exp(sharpness * np.stack([field(places) for field in fields], axis=1))
        return weights / weights.sum(axis=1, keepdims=True)

    return pattern


def striped(axis: int, period: float, share: float = 0.5) -> Pattern:
    """Two materials in turn along an axis, with a border of a tenth of the period."""

    def pattern(places: Array) -> Array:
        phase = np.abs((places[:, axis] / period) % 1.0 - 0.5) * 2.0
        first = np.clip((share - phase) / 0.2 + 0.5, 0, 1)
        return np.stack([first, 1 - first], axis=1)

    return pattern


def graded(axis: int, low: float, high: float) -> Pattern:
    """From the first material at `low` to the second at `high`."""

    def pattern(places: Array) -> Array:
        second = np.clip((places[:, axis] - low) / (high - low), 0, 1)
        return np.stack([1 - second, second], axis=1)

    return pattern


# Shapes


def ball(
    radius: float, centre: Sequence[float], bumps: Callable[[Array], Array] | None = None
) -> trimesh.Trimesh:
    """A sphere; `bumps` of its unit directions are relative changes of the radius."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    reach = radius * (1.0 if bumps is None else 1.0 + bumps(np.asarray(mesh.vertices))[:, None])
    mesh.vertices = np.asarray(mesh.vertices) * reach + np.asarray(centre)
    return mesh


def turned(
    profile: Sequence[tuple[float, float]], centre: Sequence[float], sections: int = 96
) -> trimesh.Trimesh:
    """What a lathe makes of a profile of (radius, height), closed where the radius is 0."""
    corners = np.asarray(profile, float)
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    fine = np.linspace(0, steps.sum(), 160)
    along = np.concatenate([[0], np.cumsum(steps)])
    line = np.stack([np.interp(fine, along, corners[:, axis]) for axis in (0, 1)], axis=1)
    mesh = trimesh.creation.revolve(line, sections=sections)
    mesh.apply_translation(centre)
    return mesh


def ring(radius: float, tube: float, centre: Sequence[float], tilt: float = 0.0) -> trimesh.Trimesh:
    """A torus, tilted about x by radians."""
    mesh = trimesh.creation.torus(radius, tube, major_sections=96, minor_sections=48)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(tilt, [1, 0, 0]))
    mesh.apply_translation(centre)
    return mesh


def block(
    sizes: Sequence[float], centre: Sequence[float], turn: float = 0.0, edge: float | None = None
) -> trimesh.Trimesh:
    """A box turned about z by radians; its triangles have edges of at most `edge`."""
    mesh = trimesh.creation.box(extents=np.asarray(sizes, float))
    mesh = mesh.subdivide_to_size(edge or max(sizes) / 40, max_iter=12)
    assert isinstance(mesh, trimesh.Trimesh)
    mesh = _with_flat_faces(mesh)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    mesh.apply_translation(centre)
    return mesh


def leaf(
    start: Sequence[float], azimuth: float, length: float, width: float, rise: float, droop: float
) -> trimesh.Trimesh:
    """A thin blade that rises and bends down, seen from both sides."""
    along, across = np.meshgrid(np.linspace(0, 1, 24), np.linspace(-1, 1, 9), indexing="ij")
    half = 0.5 * width * np.sin(np.pi * np.clip(along, 0.02, 1) ** 0.8) * across
    forward = length * along
    height = rise * along - droop * along**2 + 0.15 * width * np.abs(across)
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    places = np.stack([forward * cos - half * sin, forward * sin + half * cos, height], axis=-1).reshape(
        -1, 3
    )
    rows, columns = along.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
    return trimesh.Trimesh(places + np.asarray(start), faces, process=False)


def ground(half: float, height: float, relief: Callable[[Array], Array] | None = None) -> trimesh.Trimesh:
    """A square of land, finest in the middle; `relief` of places on it is added to its height."""
    steps = np.linspace(-1, 1, 201)
    x, y = np.meshgrid(
        half * np.sign(steps) * np.abs(steps) ** 2.2, half * np.sign(steps) * np.abs(steps) ** 2.2
    )
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    places[:, 2] = height + (0.0 if relief is None else relief(places))
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
    return trimesh.Trimesh(places, faces, process=False)


def _with_flat_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same mesh whose vertices are not shared across its edges, so that normals don't bend there."""
    normals = np.round(mesh.face_normals, 3)
    _, side = np.unique(normals, axis=0, return_inverse=True)
    parts = [mesh.submesh([np.flatnonzero(side.ravel() == k)], append=True) for k in range(side.max() + 1)]
    return trimesh.util.concatenate(parts)  # pyright: ignore[reportReturnType]
