"""Cameras of built-in scenes: square pictures, held upright.

Notation: `N` views.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float

from unmix_plugin.engine.geometry.cameras import Cameras


def upright_cameras(
    positions: Float[np.ndarray, "N 3"], backward: Float[np.ndarray, "N 3"], size: int, angle: float
) -> Cameras:
    """Pinhole cameras in a world whose z points upwards.

    Args:
        positions: In scene units.
        backward: Unit vectors against the view, none of them vertical.
        size: Rows and columns of all pictures.
        angle: Between the left and right edge of a picture, radians, below pi.
    """
    views = len(positions)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack([right, np.cross(backward, right), backward, positions], axis=2)
    return Cameras(
        torch.tensor(poses, dtype=torch.float32),
        torch.full((views, 2), float(size / 2 / np.tan(angle / 2))),
        torch.full((views, 2), size / 2),
        torch.zeros(views, 4),
        size,
        size,
    )
