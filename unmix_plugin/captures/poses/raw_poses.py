"""What a reader finds before it is checked, and how it becomes a `PoseSet`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from unmix_plugin.captures.poses.pose_set import Lens, PosedCamera, PoseSet
from unmix_plugin.captures.poses.rigid import make_rigid, name_some
from unmix_plugin.errors import CaptureError, counted

FAR = 100.0
"""Cameras further from the origin than this many times their spread are geo-referenced."""
FAR_ALONE = 1e4
"""The same for one camera, in units of the source."""


@dataclass(frozen=True)
class RawCamera:
    """A camera as written: OpenGL axes, but maybe scaled, sheared or not finite."""

    name: str
    matrix: Float64[np.ndarray, "3 4"]
    """Camera to world."""
    lens: Lens | None
    other_names: tuple[str, ...] = ()


@dataclass(frozen=True)
class SparsePoints:
    """Points of structure from motion."""

    positions: Float64[np.ndarray, "P 3"]
    colours: UInt8[np.ndarray, "P 3"] | None


def make_pose_set(
    cameras: Iterable[RawCamera],
    source: str,
    where: str,
    points: SparsePoints | None = None,
    up: Float64[np.ndarray, "3"] | None = None,
    notes: Iterable[str] = (),
) -> PoseSet:
    """Check and tidy what a reader found: rigid rotations, one camera a name, coordinates near 0.

    Args:
        where: The file, for messages.
        up: Against gravity, in the source's coordinates.
    Raises:
        CaptureError: a name twice with different poses, or a matrix is not a pose.
    """
    unique, repeated = _unique(cameras, where)
    poses, made_rigid = make_rigid({name: camera.matrix for name, camera in unique.items()}, where)
    offset = find_offset(np.stack([pose[:, 3] for pose in poses.values()]))
    moved = np.column_stack([np.zeros((3, 3)), offset])
    posed = {
        name: PosedCamera(poses[name] - moved, camera.lens, camera.other_names)
        for name, camera in unique.items()
    }
    said = [*notes, *made_rigid]
    if repeated:
        said.append(
            f"{counted(len(repeated), 'camera')} listed twice with the same pose: {name_some(repeated)}"
        )
    if offset.any():
        said.append(f"coordinates are large: less the offset {', '.join(f'{value:.0f}' for value in offset)}")
    kept = _finite(points)
    if points is not None and kept is not None and len(kept.positions) < len(points.positions):
        said.append(f"{len(points.positions) - len(kept.positions)} sparse points are not finite: left out")
    return PoseSet(
        cameras=posed,
        source=source,
        points=None if kept is None else kept.positions - offset,
        colours=None if kept is None else kept.colours,
        offset=offset,
        up=None if up is None else up / np.linalg.norm(up),
        notes=tuple(said),
    )


def find_offset(positions: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "3"]:
    """What to subtract so that float32 suffices: the mean, in whole units, if far from 0 against the spread, or 0."""
    middle = positions.mean(axis=0)
    spread = float(np.linalg.norm(positions - middle, axis=1).max())
    distance = float(np.linalg.norm(middle))
    is_far = distance > FAR * spread if spread > 0 else distance > FAR_ALONE
    return np.round(middle) if is_far else np.zeros(3)


def _unique(cameras: Iterable[RawCamera], where: str) -> tuple[dict[str, RawCamera], list[str]]:
    unique: dict[str, RawCamera] = {}
    repeated: list[str] = []
    for camera in cameras:
        first = unique.setdefault(camera.name, camera)
        if first is camera:
            continue
        if not np.array_equal(first.matrix, camera.matrix) or first.lens != camera.lens:
            raise CaptureError(
                f"{where} has two cameras of the name {camera.name} with different poses; expected one for each "
                "image: rename or remove one"
            )
        repeated.append(camera.name)
    return unique, repeated


def _finite(points: SparsePoints | None) -> SparsePoints | None:
    if points is None or len(points.positions) == 0:
        return None
    good = np.isfinite(points.positions).all(axis=1)
    return SparsePoints(points.positions[good], None if points.colours is None else points.colours[good])
