"""Where the cameras of built-in objects are: around the object, above and below.

Notation: `N` views.
"""

from __future__ import annotations

import numpy as np

from unmix_plugin.engine.geometry.camera_paths import upright_cameras
from unmix_plugin.engine.geometry.cameras import Cameras

_DISTANCE = 4.2
_ELEVATIONS_DEG = (-40.0, 70.0)
_MARGIN = 1.12
"""Half of a picture, as a multiple of the object's radius."""


def viewpoints(views: int, size: int, radius: float, first: int = 0) -> Cameras:
    """Square pinhole cameras that look at the origin, azimuths spread by the golden angle.

    Args:
        views: N.
        size: Rows and columns.
        radius: Of a ball about the origin that each picture shows whole, below 3.
        first: Number of the first view; other numbers are other places.
    """
    i = first + np.arange(views)
    azimuths = i * np.pi * (3 - np.sqrt(5))
    # A second irrational stride decouples elevation from order, so that any few views see all sides.
    shares = (i * np.sqrt(2) + 0.5) % 1
    low, high = np.sin(np.deg2rad(_ELEVATIONS_DEG))
    z = low + (high - low) * shares
    flat = np.sqrt(1 - z**2)
    backward = np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), z], axis=1)
    half_angle = np.arcsin(min(_MARGIN * radius / _DISTANCE, 0.95))
    return upright_cameras(_DISTANCE * backward, backward, size, 2 * half_angle)
