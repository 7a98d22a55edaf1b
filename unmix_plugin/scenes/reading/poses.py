"""Camera poses: a matrix of JSON to a rigid transform."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.json_values import describe, read_number

RIGID_TOLERANCE = 5e-3
"""Largest element of R^T R - 1 that passes as rounding of printed digits; the rotation nearest to R is then taken."""

MAX_DISTANCE = 1e9
"""Camera positions beyond this are damage; squares of larger ones would leave float32."""


def read_pose(
    matrix: Any, where: str, faults: Faults, name: str = "'transform_matrix'"
) -> Float64[np.ndarray, "3 4"] | None:
    """Check a `transform_matrix` (4x4 or 3x4, OpenGL camera to world); None and a noted fault if it is not a pose.

    Args:
        name: What messages call it.
    """
    rows = _read_rows(matrix)
    if rows is None:
        found = "is absent" if matrix is None else f"is {_found(matrix)}"
        faults.add(where, f"{name} {found}; expected 4 (or 3) rows of 4 finite numbers, camera to world")
        return None
    if len(rows) == 4 and np.abs(rows[3] - np.array([0.0, 0.0, 0.0, 1.0])).max() > 1e-6:
        last = ", ".join(f"{value:g}" for value in rows[3])
        faults.add(where, f"{name} is not rigid: its last row is ({last}); expected (0, 0, 0, 1)")
        return None
    rotation, position = rows[:3, :3], rows[:3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= RIGID_TOLERANCE:
        lengths = ", ".join(f"{math.hypot(*axis):.4g}" for axis in rotation.T)  # hypot does not overflow
        message = f"{name} is not rigid: its axes have lengths ({lengths}) and R^T R is off the identity"
        faults.add(where, f"{message} by {deviation:.3g}; expected a rotation without scale or shear")
        return None
    if np.linalg.det(rotation) < 0.0:
        faults.add(where, f"{name} is a reflection (determinant -1); expected a rotation, flip one axis")
        return None
    if np.abs(position).max() > MAX_DISTANCE:
        faults.add(
            where,
            f"{name} puts the camera at {position.tolist()}; expected less than 1e9 units away",
        )
        return None
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, position[:, None]], axis=1)


def _read_rows(matrix: Any) -> Float64[np.ndarray, "rows 4"] | None:
    if not isinstance(matrix, list) or len(matrix) not in (3, 4):
        return None
    if not all(isinstance(row, list) and len(row) == 4 for row in matrix):
        return None
    numbers = [[read_number(value) for value in row] for row in matrix]
    if any(number is None for row in numbers for number in row):
        return None
    return np.array(numbers, dtype=np.float64)


def _found(matrix: Any) -> str:
    """What stands in place of rows of numbers: a value that is no number, or else the whole."""
    if isinstance(matrix, list):
        for number, row in enumerate(matrix):
            if not isinstance(row, list) or len(row) != 4:
                return f"{describe(matrix)} whose row {number} is {describe(row)}"
            for value in row:
                if read_number(value) is None:
                    return f"{describe(matrix)} rows with {describe(value)} in row {number}"
    return describe(matrix)
