"""Where cameras look: the point nearest to their optical axes, and whether these meet there.

Notation: `N` cameras; poses are camera to world, OpenGL axes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

LEAST_CONVERGENCE = 1e-3
"""Least mean squared sine between optical axes and the direction that they spread from least, (1.8 deg)^2, with which
the nearest point is fixed at all."""
LEAST_SPREAD_DEG = 6.0
"""Root mean square of that angle for cameras turned about a subject; a flight whose camera sways has less."""
MOST_MISSED = 0.25
"""By how much half of the axes may miss the point, over their depth there."""


def focus_point(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "3"] | None:
    """The point nearest to all optical axes, least squares; None if they are parallel or most point away from it."""
    if _convergence(poses) < LEAST_CONVERGENCE:
        return None
    across = _across(poses)
    point = np.linalg.solve(across.mean(axis=0), (across @ poses[:, :, 3:]).mean(axis=0)[:, 0])
    depths = ((point - poses[:, :, 3]) * -poses[:, :, 2]).sum(axis=-1)
    return point if (depths > 0.0).mean() > 0.5 else None


def meeting_point(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "3"] | None:
    """That point where the axes meet well enough to say that the subject is there, otherwise None.

    They do not where cameras look down on land from an aircraft, side by side at something flat, or around themselves.
    """
    point = focus_point(poses)
    if point is None or _convergence(poses) < np.sin(np.radians(LEAST_SPREAD_DEG)) ** 2:
        return None
    towards, forward = point - poses[:, :, 3], -poses[:, :, 2]
    depths = (towards * forward).sum(axis=-1)
    missed = np.linalg.norm(towards - depths[:, None] * forward, axis=-1)
    return point if np.median(missed / np.abs(depths).clip(min=1e-12)) <= MOST_MISSED else None


def _across(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "N 3 3"]:
    """Projections of space to what is square to each optical axis."""
    axes = poses[:, :, 2]
    return np.eye(3) - axes[:, :, None] * axes[:, None, :]


def _convergence(poses: Float64[np.ndarray, "N 3 4"]) -> float:
    return float(np.linalg.eigvalsh(_across(poses).mean(axis=0))[0])
