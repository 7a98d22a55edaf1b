"""Where the demo scene is: in front of nothing, on a ground that runs to the horizon under a sky, or in a room.

Notation: `R` rays, `P` points, `K` materials.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.upright_cameras import upright_cameras
from unmix_plugin.scenes.demo.materials import MATERIALS, Blend, Surface, plain, smooth_step
from unmix_plugin.scenes.demo.shading import THINGS, Sky, Thing
from unmix_plugin.scenes.demo.shapes import Placement
from unmix_plugin.scenes.demo.views import demo_cameras

_GROUND_HEIGHT = -0.12
"""The table's underside."""
_GROUND_EDGE = 400.0
"""Half of the ground's edge, scene units: its end is a tenth of a pixel below the horizon."""
_SKY_BRIGHTNESS = 0.75
_PHONE_ANGLE_DEG = 62.0


@dataclass(frozen=True)
class Place:
    """What there is to see, and from where."""

    things: Sequence[Thing]
    cameras: Callable[[int, int], Cameras]
    """From the pixels along an edge of a view and the number of views."""
    sky: Sky | None = None
    """What is behind all things; None leaves their pictures an alpha."""


def open_sky(directions: Float[np.ndarray, "R 3"]) -> Float[np.ndarray, "R K"]:
    """Cyan above, white at the horizon, with broad clouds."""
    x, y, z = directions.T
    haze = np.exp(-4.0 * z.clip(0))
    clouds = smooth_step(np.sin(4.0 * x + 1.0) * np.sin(5.0 * y) + np.sin(7.0 * (x - y)) / 2, 0.1, 0.9)
    white = np.maximum(haze, 0.7 * clouds * (1 - haze))
    found = np.zeros((len(directions), len(MATERIALS)), np.float32)
    found[:, MATERIALS.index("white")] = _SKY_BRIGHTNESS * white
    found[:, MATERIALS.index("cyan")] = _SKY_BRIGHTNESS * (1 - white)
    return found


def patches(period: float, seed: float, fade: float = np.inf) -> Blend:
    """Smooth patches of a surface, about `period` of its own units wide, which fade at distances around `fade`."""

    def blend(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
        x, y = (points[:, :2] * (2 * np.pi / period)).T
        z = points[:, 2] * (2 * np.pi / period)
        waves = np.sin(x + seed) * np.sin(y + z) + np.sin(0.37 * x - 0.61 * y + z + seed)
        waves += np.sin(1.7 * y + 0.4 * x - 0.8 * z)
        contrast = np.exp(-(points[:, :2] ** 2).sum(axis=1) / fade**2)
        return (0.5 + contrast * (smooth_step(waves, -0.6, 0.6) - 0.5)).astype(points.dtype)

    return blend


def _ground() -> Thing:
    # A cylinder's or a box's own coordinates are over its half sizes.
    period, fade = 1.3 / _GROUND_EDGE, 9.0 / _GROUND_EDGE
    placement = Placement("box", (0.0, 0.0, _GROUND_HEIGHT - 0.5), (_GROUND_EDGE, _GROUND_EDGE, 0.5))
    return Thing(placement, Surface("green", "yellow", patches(period, 0.7, fade)))


def _far_things(count: int = 14, seed: int = 5) -> list[Thing]:
    """Huts and trees around the table, 6 to 60 units away."""
    generator, found = np.random.default_rng(seed), []
    for index in range(count):
        angle = 2 * np.pi * (index + 0.6 * generator.random()) / count
        distance = 6.0 * 10.0 ** (index * 5 % count / count)
        size = distance * generator.uniform(0.06, 0.12)
        center = (distance * np.cos(angle), distance * np.sin(angle), _GROUND_HEIGHT + size)
        names = [str(name) for name in generator.choice(MATERIALS, 2, replace=False)]
        primitive = ("box", "sphere", "cylinder")[index % 3]
        placement = Placement(primitive, center, (size, size, size), turn_deg=float(generator.uniform(0, 90)))
        blend = plain if index % 2 else patches(1.3, float(index))
        found.append(Thing(placement, Surface(names[0], names[1], blend)))
    return found


def _room() -> list[Thing]:
    """Floor, ceiling and walls around the table, one wall with two windows."""
    slabs = [
        ((0.0, 0.0, _GROUND_HEIGHT - 0.09), (3.6, 3.6, 0.1), "yellow", "red"),
        ((0.0, 0.0, 5.0), (3.6, 3.6, 0.1), "white", "white"),
        ((-3.6, 0.0, 2.4), (0.1, 3.6, 2.6), "cyan", "white"),
        ((3.6, 0.0, 2.4), (0.1, 3.6, 2.6), "white", "purple"),
        ((0.0, -3.6, 2.4), (3.6, 0.1, 2.6), "white", "green"),
        # The wall with windows: below, above, and the posts between.
        ((0.0, 3.6, 0.4), (3.6, 0.1, 0.6), "white", "green"),
        ((0.0, 3.6, 3.8), (3.6, 0.1, 1.2), "white", "green"),
        ((-3.0, 3.6, 1.8), (0.6, 0.1, 0.8), "white", "green"),
        ((0.0, 3.6, 1.8), (0.4, 0.1, 0.8), "white", "green"),
        ((3.0, 3.6, 1.8), (0.6, 0.1, 0.8), "white", "green"),
        ((-2.4, 2.4, 0.5), (0.6, 0.5, 0.7), "purple", "white"),
        ((1.9, 2.2, 0.9), (0.35, 0.35, 1.1), "green", "yellow"),
    ]
    return [
        Thing(
            Placement("box", center, half), Surface(first, second, _in_world(half, patches(0.9, 1.3 * index)))
        )
        for index, (center, half, first, second) in enumerate(slabs)
    ]


def _in_world(half_sizes: tuple[float, float, float], blend: Blend) -> Blend:
    """A blend of points in scene units, though a shape's own coordinates are over its half sizes."""
    sizes = np.asarray(half_sizes, np.float32)
    return lambda points: blend(points * sizes)


def room_cameras(size: int, views: int, seed: int = 11) -> Cameras:
    """Cameras as of a hand-held phone on one side of the room, turned towards the table and the windows behind it."""
    generator = np.random.default_rng(seed)
    shifts = generator.uniform(-1, 1, (views, 3))
    positions = np.array([0.0, -2.3, 1.5]) + shifts * (1.2, 0.5, 0.6)
    targets = np.array([0.0, 1.2, 0.9]) + generator.uniform(-1, 1, (views, 3)) * (1.0, 0.3, 0.4)
    backward = positions - targets
    backward /= np.linalg.norm(backward, axis=1, keepdims=True)
    return upright_cameras(positions, backward, size, np.deg2rad(_PHONE_ANGLE_DEG))


TABLE = Place(THINGS, demo_cameras)
"""The table before nothing."""
WORLD = Place((*THINGS, _ground(), *_far_things()), demo_cameras, open_sky)
"""The table on a ground that runs to the horizon, with huts and trees, under a sky."""
ROOM = Place((*THINGS, *_room(), _ground(), *_far_things(20, seed=8)), room_cameras, open_sky)
"""The table in a room with windows onto the same world."""
PLACES: Mapping[str, Place] = {"table": TABLE, "world": WORLD, "room": ROOM}
