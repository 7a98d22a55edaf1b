"""Two sets of poses of the same images compared: the similarity between their worlds, and what is left in pixels.

Notation: `N` cameras, `P` points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.captures.poses.pose_factory import LENS
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.engine.geometry.camera_paths import focus_point
from unmix_plugin.scenes.placement import Placement

Poses = Float64[np.ndarray, "N 3 4"]


@dataclass(frozen=True)
class Alignment:
    """How estimated poses differ from true ones."""

    similarity: Placement
    """From the estimated world to the true one."""
    names: tuple[str, ...]
    """Images that both have."""
    errors_px: Float64[np.ndarray, " N"]
    """Root mean square distance of projected points, for each of them."""
    rotation_errors_deg: Float64[np.ndarray, " N"]
    position_errors: Float64[np.ndarray, " N"]
    """In units of the true world."""

    @property
    def rms_px(self) -> float:
        """Root mean square over all cameras."""
        return float(np.sqrt(np.mean(self.errors_px**2)))


def align_poses(estimated: PoseSet, truth: PoseSet, names: dict[str, str] | None = None) -> Alignment:
    """Find the similarity after which the estimated cameras see points where the true ones do, and what is left.

    Points are the sparse ones of the true poses or of the estimated ones, or some around where the cameras look.

    Args:
        names: True name of each estimated one; None where both are the same.
    """
    pairs = names or {name: name for name in estimated.cameras}
    shared = {a: b for a, b in pairs.items() if a in estimated.cameras and b in truth.cameras}
    assert len(shared) >= 3
    mine, theirs = [estimated.cameras[a] for a in shared], [truth.cameras[b] for b in shared.values()]
    first, reach = _first_guess(_stacked(mine), _stacked(theirs))
    points = truth.points
    if points is None:
        around = _around(_stacked(theirs), reach)
        points = around if estimated.points is None else first.to_scene(estimated.points)
    points = points[:: max(1, len(points) // 400)]
    wanted = np.stack([camera.pixels_of(points) for camera in theirs])
    sizes = np.array([[c.lens.width, c.lens.height] for c in theirs if c.lens is not None])[:, None]
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((wanted >= 0) & (wanted <= sizes)).all(axis=-1))
    seen = np.isfinite(wanted).all(axis=-1) & (inside | (inside.sum(axis=1) == 0)[:, None])
    pivot = points.mean(axis=0)

    def changed(step: np.ndarray) -> Placement:
        """The first guess, then a turn, growth and shift about the middle of the points."""
        turn, growth = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[3]))
        shift = pivot + step[4:] - growth * turn @ pivot
        scale = first.scale * growth
        return Placement(turn @ first.rotation, turn @ first.translation + shift / scale, scale)

    def off(way: Placement) -> Float64[np.ndarray, "N P 2"]:
        return np.stack([camera.moved(way).pixels_of(points) for camera in mine]) - wanted

    def errors(step: np.ndarray) -> np.ndarray:
        return np.nan_to_num(off(changed(step))[seen].ravel(), nan=1e4)

    best = changed(least_squares(errors, np.zeros(7), x_scale=[1e-3] * 4 + [1e-3 * reach] * 3).x)
    squared = np.where(seen, (off(best) ** 2).sum(axis=-1), np.nan)
    found, true = _stacked([camera.moved(best) for camera in mine]), _stacked(theirs)
    turns = Rotation.from_matrix(found[:, :, :3].transpose(0, 2, 1) @ true[:, :, :3]).magnitude()
    places = np.linalg.norm(found[:, :, 3] - true[:, :, 3], axis=1)
    errors_px = np.sqrt(np.nanmean(squared, axis=1))
    return Alignment(best, tuple(shared.values()), errors_px, np.degrees(turns), places)


def _stacked(cameras: list[PosedCamera]) -> Poses:
    return np.stack([camera.camera_to_world for camera in cameras])


def _first_guess(mine: Poses, theirs: Poses) -> tuple[Placement, float]:
    """By the mean turn, middle and extent of the cameras; and the extent of the true ones."""
    middles = [poses[:, :, 3].mean(axis=0) for poses in (mine, theirs)]
    away = [poses[:, :, 3] - middle for poses, middle in zip((mine, theirs), middles, strict=True)]
    extents = [float(np.linalg.norm(steps, axis=1).mean()) or 1.0 for steps in away]
    scale = extents[1] / extents[0]
    turns = Rotation.from_matrix(theirs[:, :, :3] @ mine[:, :, :3].transpose(0, 2, 1))
    rotation = turns.mean().as_matrix()
    return Placement(rotation, middles[1] / scale - rotation @ middles[0], scale), extents[1]


def _around(poses: Poses, reach: float) -> Float64[np.ndarray, "P 3"]:
    """A cross around where the cameras look."""
    middle = focus_point(poses)
    if middle is None:
        middle = (poses[:, :, 3] - reach * poses[:, :, 2]).mean(axis=0)
    return middle + 0.1 * reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


TURN = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
SIMILARITY = Placement(TURN, np.array([1.0, 2.0, -3.0]), 2.5)


def elsewhere(poses: PoseSet) -> PoseSet:
    back = SIMILARITY.rotation.T
    way = Placement(back, -SIMILARITY.scale * back @ SIMILARITY.translation, 1 / SIMILARITY.scale)
    return replace(poses, cameras={name: camera.moved(way) for name, camera in poses.cameras.items()})


def in_a_row() -> PoseSet:
    poses = {str(x): np.column_stack([np.eye(3), [x, 0.0, 5.0 + 0.1 * x]]) for x in range(4)}
    return PoseSet({name: PosedCamera(pose, LENS) for name, pose in poses.items()}, "a row")
