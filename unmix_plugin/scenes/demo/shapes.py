"""Analytic ray casting of the demo scene: spheres, cylinders and boxes under affine maps.

Notation: `R` rays, `P` points. Every primitive is convex and lives in its own coordinates: the unit sphere, the
cylinder of radius 1 with |z| <= 1, the box with |x|, |y|, |z| <= 1. A ray is taken there without normalising its
direction again, so that a distance along it means the same in the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

Points = Float[np.ndarray, "P 3"]
Rays = Float[np.ndarray, "R 3"]
PerRay = Float[np.ndarray, " R"]
_Primitive = Literal["sphere", "cylinder", "box"]
_SELF_HIT_DISTANCE = 1e-4
"""A ray that starts on a surface meets it again within this distance, scene units, by rounding alone."""


@dataclass(frozen=True)
class PlacedPrimitive:
    """A primitive put into the world: scaled, turned about the vertical, tilted about x, then moved."""

    primitive: _Primitive
    center: tuple[float, float, float]
    half_sizes: tuple[float, float, float]
    """Half the extent along each own axis, scene units."""
    turn_deg: float = 0.0
    tilt_deg: float = 0.0

    @cached_property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """World directions of the own axes, as columns."""
        turn, tilt = np.deg2rad(self.turn_deg), np.deg2rad(self.tilt_deg)
        about_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        about_x = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        return about_z @ about_x

    def to_local(self, points: Points) -> Points:
        """World points in own coordinates."""
        center = np.asarray(self.center, dtype=points.dtype)
        return self._directions_to_local(points - center)

    def _directions_to_local(self, directions: Points) -> Points:
        """World directions in own coordinates, lengths scaled."""
        return directions @ (self.axes / self.half_sizes).astype(directions.dtype)

    def _normals_to_world(self, normals: Points) -> Points:
        """Own normals as unit normals in the world."""
        world = normals @ (self.axes / self.half_sizes).T.astype(normals.dtype)
        return world / np.sqrt(dot(world, world))[:, None]

    def entry_distances(self, origins: Rays, directions: Rays) -> PerRay:
        """Distances, in lengths of the direction, at which rays enter from outside; inf where they never do."""
        local_origins, local_directions = self.to_local(origins), self._directions_to_local(directions)
        near, far = _INTERVALS[self.primitive](local_origins, local_directions)
        return np.where((near < far) & (near > _SELF_HIT_DISTANCE), near, np.inf).astype(origins.dtype)

    def normals_at(self, local_points: Points) -> Points:
        """Unit normals in the world at points of the surface given in own coordinates."""
        if self.primitive == "sphere":
            return self._normals_to_world(local_points)
        normals = np.zeros_like(local_points)
        if self.primitive == "cylinder":
            on_cap = np.abs(local_points[:, 2]) > np.hypot(local_points[:, 0], local_points[:, 1])
            normals[:, :2] = np.where(on_cap[:, None], 0, local_points[:, :2])
            normals[:, 2] = np.where(on_cap, np.sign(local_points[:, 2]), 0)
        else:
            face = np.abs(local_points).argmax(axis=1)
            rows = np.arange(len(local_points))
            normals[rows, face] = np.sign(local_points[rows, face])
        return self._normals_to_world(normals)


def dot(a: Float[np.ndarray, "P C"], b: Float[np.ndarray, "P C"]) -> Float[np.ndarray, " P"]:
    """Products row by row; several times faster than a sum over so short an axis."""
    return np.einsum("ij,ij->i", a, b)


def first_hits(
    placements: Sequence[PlacedPrimitive], origins: Rays, directions: Rays
) -> tuple[PerRay, Int[np.ndarray, " R"]]:
    """Distance of the nearest surface along each ray (inf where nothing is hit), and which placement it is of."""
    distances = np.stack([placement.entry_distances(origins, directions) for placement in placements])
    return distances.min(axis=0), distances.argmin(axis=0)


def _quadratic_interval(a: PerRay, half_b: PerRay, c: PerRay) -> tuple[PerRay, PerRay]:
    """Where a t^2 + 2 half_b t + c < 0, for a > 0; an empty interval (inf, -inf) where nowhere."""
    discriminant = half_b**2 - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    is_hit = discriminant > 0
    return np.where(is_hit, (-half_b - root) / a, np.inf), np.where(is_hit, (-half_b + root) / a, -np.inf)


def _slab_interval(
    origins: Float[np.ndarray, "*axes"], directions: Float[np.ndarray, "*axes"]
) -> tuple[Float[np.ndarray, "*axes"], Float[np.ndarray, "*axes"]]:
    """Where |origin + t direction| < 1, along each axis by itself."""
    # A direction along the axis's plane gets a very long interval, or none, instead of 0 / 0.
    inverse = 1 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    low, high = (-1 - origins) * inverse, (1 - origins) * inverse
    return np.minimum(low, high), np.maximum(low, high)


def _sphere_interval(origins: Rays, directions: Rays) -> tuple[PerRay, PerRay]:
    return _quadratic_interval(
        dot(directions, directions), dot(origins, directions), dot(origins, origins) - 1
    )


def _cylinder_interval(origins: Rays, directions: Rays) -> tuple[PerRay, PerRay]:
    flat_origins, flat_directions = origins[:, :2], directions[:, :2]
    # A ray along the axis has a = 0; the floor makes it a very long but right interval.
    a = np.maximum(dot(flat_directions, flat_directions), 1e-12)
    side = _quadratic_interval(a, dot(flat_origins, flat_directions), dot(flat_origins, flat_origins) - 1)
    caps = _slab_interval(origins[:, 2], directions[:, 2])
    return np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])


def _box_interval(origins: Rays, directions: Rays) -> tuple[PerRay, PerRay]:
    near, far = _slab_interval(origins, directions)
    return np.maximum.reduce([*near.T]), np.minimum.reduce([*far.T])


_INTERVALS = {"sphere": _sphere_interval, "cylinder": _cylinder_interval, "box": _box_interval}
