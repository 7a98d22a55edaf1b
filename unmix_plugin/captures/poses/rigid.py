"""Camera matrices of other programs made rigid: a rotation and a position, nothing else.

Notation: a matrix (3, 4) maps camera to world; its left part is s R with a rotation R and a scale s > 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import CaptureError

SHEAR_TOLERANCE = 5e-3
"""Largest element of R^T R - 1, after the scale is taken out, that passes as rounding of printed digits."""
SCALE_TOLERANCE = 1e-3
"""Scales this near to 1 are rounding too, and not mentioned."""
GREATEST_POSITION = 1e9
"""Positions beyond this are damage."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""From OpenGL to OpenCV camera axes and back, from the right."""
MAX_NAMED = 3


def make_rigid(
    matrices: Mapping[str, Float64[np.ndarray, "3 4"]], where: str
) -> tuple[dict[str, Float64[np.ndarray, "3 4"]], tuple[str, ...]]:
    """The poses with orthonormal rotations of determinant 1; positions are kept.

    Args:
        matrices: Camera to world by the name of the image, any camera axes that are right-handed.
        where: The file, for messages.
    Returns:
        The poses, and what was changed, one sentence each.
    Raises:
        CaptureError: there is no camera, or a matrix is not a similarity: zeros, not finite, sheared, mirrored, far
            away.
    """
    if not matrices:
        raise CaptureError(f"{where} has no camera; expected one for each view, export it again")
    _refuse(matrices, where)
    scales = {name: float(np.cbrt(np.linalg.det(matrix[:, :3]))) for name, matrix in matrices.items()}
    rigid = {
        name: np.column_stack([nearest_rotation(matrix[:, :3]), matrix[:, 3]])
        for name, matrix in matrices.items()
    }
    first = next(iter(rigid.values()))
    if len(rigid) > 1 and all(np.array_equal(first, pose) for pose in rigid.values()):
        raise CaptureError(
            f"{where}: all {len(rigid)} cameras have the same pose; expected different ones, estimate them again"
        )
    scaled = [scale for scale in scales.values() if abs(scale - 1.0) > SCALE_TOLERANCE]
    if not scaled:
        return rigid, ()
    low, high = min(scaled), max(scaled)
    factor = f"{low:.4g}" if high - low <= 1e-3 * high else f"{low:.4g} to {high:.4g}"
    note = f"the rotations of {len(scaled)} of {len(rigid)} cameras were scaled by {factor}; made rigid, positions kept"
    return rigid, (note,)


def nearest_rotation(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The orthonormal matrix nearest to a scaled one."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt


def name_some(names: Sequence[str]) -> str:
    """A few names for a message, and how many more there are."""
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return ", ".join(names[:MAX_NAMED]) + more


def _refuse(matrices: Mapping[str, Float64[np.ndarray, "3 4"]], where: str) -> None:
    faulty: dict[str, list[str]] = {}
    for name, matrix in matrices.items():
        if (fault := _fault(matrix)) is not None:
            faulty.setdefault(fault, []).append(name)
    if not faulty:
        return
    listed = "; ".join(f"{name_some(names)}: {fault}" for fault, names in faulty.items())
    raise CaptureError(
        f"{where} has {sum(map(len, faulty.values()))} of {len(matrices)} camera matrices that are not poses: "
        f"{listed}; "
        "expected camera to world, a rotation (or a scaled one) and a position: remove these frames or export again"
    )


def _fault(matrix: Float64[np.ndarray, "3 4"]) -> str | None:
    """What is wrong with a matrix; None if it is a similarity."""
    if not np.isfinite(matrix).all():
        return "the matrix has numbers that are not finite"
    if np.abs(matrix).max() > GREATEST_POSITION:
        return "the camera is more than 1e9 units away, or its rotation scaled by more"
    left = matrix[:, :3]
    lengths = np.linalg.norm(left, axis=0)
    if lengths.max() < 1e-9:
        return "the rotation is all zeros"
    gram = left.T @ left / np.mean(lengths**2)
    if np.abs(gram - np.eye(3)).max() > SHEAR_TOLERANCE:
        axes = ", ".join(f"{length:.4g}" for length in lengths)
        return f"the rotation is sheared (its axes have lengths {axes})"
    if np.linalg.det(left) < 0:
        return "the rotation is a mirror image (determinant below 0), so an axis has the wrong sign"
    return None
