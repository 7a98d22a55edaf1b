"""The demo scene before and after one planted change, as other cameras see it in other light.

What differs between the two captures besides the change: the cameras, the world (turned, moved, larger) and the light
(a factor, the same in every band). Regions are balls of the world of the first capture.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64

from unmix_plugin.engine.geometry.camera_paths import upright_cameras
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.demo.scene import Place, make_demo_scene
from unmix_plugin.scenes.demo.shading import MATERIALS, THINGS, Surface, Thing, smooth_step
from unmix_plugin.scenes.demo.shapes import PerRay, PlacedPrimitive, Points

BEFORE_LIGHT, MORE_LIGHT = 0.75, 1.2
"""Of the first capture, so that what is lit more stays below full scale; and of the others, of that."""
SIZE = 2.6
"""Diameter of the plate that all stands on, units of the first capture's world."""
_EDGE = 0.015
"""Width of the borders of what is planted, the same unit."""
_STILL = 0.75
"""What abundances of the second material are multiplied with everywhere, so that there is room for more."""


@dataclass(frozen=True)
class Region:
    """Where something was planted."""

    center: tuple[float, float, float]
    radius: float

    def shares(self, points: Points) -> PerRay:
        """1 inside, 0 outside; world points."""
        away = np.linalg.norm(points - np.asarray(self.center, points.dtype), axis=1)
        return 1 - smooth_step(away, self.radius - _EDGE / 2, self.radius + _EDGE / 2)

    def has(self, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, " P"]:
        """Which world points are in it."""
        return np.linalg.norm(points - np.asarray(self.center), axis=1) < self.radius


@dataclass(frozen=True)
class Planted:
    """One change."""

    name: str
    region: Region | None = None
    added: float = 0.0
    """Abundance of the second material of whatever is there."""
    stain: str | None = None
    """Material that covers what was there."""
    bump: float = 0.0
    """Height of a swelling, world units; the dent is the same with the captures in the other order."""


ON_BOX, ON_PLATE = Region((0.5, 0.42, 0.6), 0.37), Region((0.02, -0.97, 0.0), 0.26)
CHANGES = (
    Planted("none"),
    Planted("abundance", ON_BOX, added=0.2),
    Planted("stain", ON_PLATE, stain="purple"),
    Planted("dent", ON_PLATE, bump=0.01 * SIZE),
)


@dataclass(frozen=True)
class _ChangedSurface(Surface):
    """A surface with a change, which knows where in the world it is."""

    placement: PlacedPrimitive = PlacedPrimitive("sphere", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    change: Planted = CHANGES[0]

    def abundances(self, local_points: Points) -> Float[np.ndarray, "P K"]:
        share = _STILL * self.blend(local_points)
        half = np.asarray(self.placement.half_sizes)
        world = local_points @ (self.placement.axes * half).T.astype(local_points.dtype)
        world = world + np.asarray(self.placement.center, local_points.dtype)
        region = self.change.region
        inside = np.zeros_like(share) if region is None else region.shares(world)
        share = share + self.change.added * inside
        result = np.zeros((len(local_points), len(MATERIALS)), dtype=local_points.dtype)
        result[:, MATERIALS.index(self.first)] += 1 - share
        result[:, MATERIALS.index(self.second)] += share
        if self.change.stain is not None:
            other = np.eye(len(MATERIALS), dtype=result.dtype)[MATERIALS.index(self.change.stain)]
            result += inside[:, None] * (other - result)
        return result


def _things(change: Planted) -> Sequence[Thing]:
    """The demo scene's, changed."""
    flat = replace(change, bump=0.0)
    changed = [
        replace(
            thing,
            surface=_ChangedSurface(
                thing.surface.first,
                thing.surface.second,
                thing.surface.blend,
                thing.surface.roughness,
                thing.placement,
                flat,
            ),
        )
        for thing in THINGS
    ]
    if change.bump > 0 and change.region is not None:
        plate, region = THINGS[0], change.region
        placement = PlacedPrimitive("sphere", region.center, (region.radius, region.radius, change.bump))

        def as_on_the_plate(points: Points) -> PerRay:
            world = points * np.asarray(placement.half_sizes, points.dtype) + np.asarray(
                placement.center, points.dtype
            )
            local = plate.placement.to_local(world)
            local[:, 2] = 1.0
            return _STILL * plate.surface.blend(local)

        changed.append(Thing(placement, Surface(plate.surface.first, plate.surface.second, as_on_the_plate)))
    return changed


def _other_cameras(size: int, views: int) -> Cameras:
    """Cameras on a dome, at other places than `demo_cameras` has them and a little nearer."""
    i = np.arange(views)
    azimuths = 0.7 + i * np.pi * (3 - np.sqrt(5))
    low, high = np.sin(np.deg2rad((19.0, 71.0)))
    heights = low + (high - low) * ((i * np.sqrt(3) + 0.3) % 1)
    flat = np.sqrt(1 - heights**2)
    backward = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), heights], axis=1)
    return upright_cameras(np.asarray((0.0, 0.0, 0.2)) + 3.9 * backward, backward, size, np.deg2rad(39.0))


OTHER_WORLD = (1.3, (0.4, -0.7, 0.6), 0.9, (2.0, -1.0, 0.5))
"""The second capture's: units of it in one of the first's, axis and angle (rad) by which it is turned, and shift."""


def other_world() -> tuple[float, Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """s, R and t that bring a world point x of the first capture to s R x + t of the second."""
    from scipy.spatial.transform import Rotation

    scale, axis, angle, shift = OTHER_WORLD
    turn = Rotation.from_rotvec(angle * np.asarray(axis) / np.linalg.norm(axis)).as_matrix()
    return scale, turn, np.asarray(shift)


def write_capture(folder: Path, change: Planted | None, size: int, bands: int, views: int) -> None:
    """The first capture where `change` is None, otherwise a later one with the change."""
    from unmix_plugin.scenes.demo.scene import demo_cameras

    planted = CHANGES[0] if change is None else change
    cameras = demo_cameras if change is None else _other_cameras
    make_demo_scene(folder, size, bands, views, place=Place(_things(planted), cameras))
    factor = BEFORE_LIGHT if change is None else BEFORE_LIGHT * MORE_LIGHT
    for path in sorted((folder / "cubes").glob("*.npy")):
        np.save(path, (np.load(path).astype(np.float32) * factor).astype(np.float16))
    if change is None:
        return
    path = folder / "transforms.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    scale, turn, shift = other_world()
    for frame in content["frames"]:
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64).numpy()
        pose[:3, 3] = scale * turn @ pose[:3, 3] + shift
        pose[:3, :3] = turn @ pose[:3, :3]
        frame["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
