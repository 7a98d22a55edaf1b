"""Cameras by the name of their image, with the sparse points that came with them.

World space is the source's, less `offset`, so that float32 has digits enough for geo-referenced cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, UInt8


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera. Pixels, with the centre of the first pixel at (0.5, 0.5)."""

    width: int
    height: int
    focal_px: tuple[float, float]
    """Along x and y."""
    center_px: tuple[float, float]
    """Principal point x, y."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 of the OPENCV model; zeros are a pinhole."""
    higher_radial: tuple[float, float] = (0.0, 0.0)
    """k3, k4: radial terms of the sixth and eighth power."""

    @property
    def radial(self) -> tuple[float, float, float, float]:
        """k1 to k4."""
        return (*self.distortion[:2], *self.higher_radial)

    @property
    def tangential(self) -> tuple[float, float]:
        """p1, p2."""
        return self.distortion[2:]


@dataclass(frozen=True)
class PosedCamera:
    """Where an image was taken from."""

    camera_to_world: Float64[np.ndarray, "3 4"]
    """Rotation (orthonormal, determinant 1) and position, OpenGL axes: +x right, +y up, looks along -z."""
    lens: Lens | None
    """None where the source gives none."""
    other_names: tuple[str, ...] = ()
    """More files of the same image that the source names, such as its cube."""


@dataclass(frozen=True)
class PoseSet:
    """All cameras of a source."""

    cameras: dict[str, PosedCamera]
    """By the name of the image as the source writes it, with folders and suffix."""
    source: str
    """What the poses come from, for people: `transforms.json`, `COLMAP model in sparse/0`."""
    points: Float64[np.ndarray, "P 3"] | None = None
    """Sparse points of structure from motion."""
    colours: UInt8[np.ndarray, "P 3"] | None = None
    """sRGB of the points."""
    offset: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Add this to positions and points to get the source's coordinates."""
    up: Float64[np.ndarray, "3"] | None = None
    """Unit vector against gravity, where the source's coordinates tell it (geo-referenced, or +z by convention)."""
    has_world: bool = True
    """Whether the coordinates mean something to the user. Those of estimated poses don't."""
    notes: tuple[str, ...] = ()
    """What was changed or is odd: rotations made rigid, frames without files, ..."""
