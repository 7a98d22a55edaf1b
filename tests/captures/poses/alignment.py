"""Two sets of poses of the same images compared: the similarity between their worlds, and what is left in pixels.

Notation: `N` cameras, `P` points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from tests.captures.poses.pose_factory import LENS
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.engine.geometry.camera_paths import focus_point
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.placement import Placement

MOST_POINTS = 400
"""Points that are projected into each camera."""
LEAST_CAMERAS = 3


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


def align_poses(
    estimated: PoseSet,
    truth: PoseSet,
    names: dict[str, str] | None = None,
    points: Float64[np.ndarray, "P 3"] | None = None,
) -> Alignment:
    """Find the similarity after which the estimated cameras see points where the true ones do, and what is left.

    Args:
        names: True name of each estimated one; None where both are the same.
        points: In the true world, less its offset; None takes the sparse points of the true poses, or of the estimated
            ones, or points around where the cameras look.
    Raises:
        CaptureError: fewer than 3 cameras with lenses are in both.
    """
    pairs = names if names is not None else {name: name for name in estimated.cameras}
    shared = {
        mine: theirs
        for mine, theirs in pairs.items()
        if mine in estimated.cameras
        and theirs in truth.cameras
        and estimated.cameras[mine].lens
        and truth.cameras[theirs].lens
    }
    if len(shared) < LEAST_CAMERAS:
        raise CaptureError(
            f"{len(shared)} cameras with lenses are in both {estimated.source} and {truth.source}; expected at least "
            f"{LEAST_CAMERAS} of the same name"
        )
    mine = [estimated.cameras[name] for name in shared]
    theirs = [truth.cameras[name] for name in shared.values()]
    reach = _extent(theirs)
    scale = reach / _extent(mine)
    for _ in range(2):  # the marks beside the estimated cameras have a length that the scale has to fit
        scale = similarity_of(_markers(mine, reach / scale), _markers(theirs, reach)).scale
    first = similarity_of(_markers(mine, reach / scale), _markers(theirs, reach))
    if points is None:
        points = _points_of(truth, estimated, first, theirs)
    points = points[:: max(1, len(points) // MOST_POINTS)]
    refined = _refine(first, mine, theirs, points)
    return _alignment(refined, tuple(shared.values()), mine, theirs, points)


def similarity_of(source: Float64[np.ndarray, "P 3"], target: Float64[np.ndarray, "P 3"]) -> Placement:
    """The similarity that maps points to points with the least squares (Umeyama 1991)."""
    source_middle, target_middle = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_middle, target - target_middle
    u, singular, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((singular * signs).sum() / (a**2).sum())
    return Placement(rotation, target_middle / scale - rotation @ source_middle, scale)


def _extent(cameras: Sequence[PosedCamera]) -> float:
    """Mean distance of cameras from their middle; 1 where they are at one place."""
    positions = np.stack([camera.camera_to_world[:, 3] for camera in cameras])
    return float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean()) or 1.0


def _markers(cameras: Sequence[PosedCamera], reach: float) -> Float64[np.ndarray, "P 3"]:
    """Positions of cameras, and points beside them along their axes, which settle the rotation of cameras in a row."""
    poses = np.stack([camera.camera_to_world for camera in cameras])
    positions = poses[:, :, 3]
    return np.concatenate([positions, *(positions + reach * poses[:, :, axis] for axis in range(3))])


def _points_of(
    truth: PoseSet, estimated: PoseSet, similarity: Placement, theirs: Sequence[PosedCamera]
) -> Float64[np.ndarray, "P 3"]:
    """Points to project, in the true world: sparse ones of either, or a cross around where the cameras look."""
    if truth.points is not None:
        return truth.points
    if estimated.points is not None:
        return similarity.to_scene(estimated.points)
    poses = np.stack([camera.camera_to_world for camera in theirs])
    reach = _extent(theirs)
    middle = focus_point(poses)
    if middle is None:
        middle = (poses[:, :, 3] - reach * poses[:, :, 2]).mean(axis=0)
    cross = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    return middle + 0.1 * reach * cross


def _refine(
    first: Placement,
    mine: Sequence[PosedCamera],
    theirs: Sequence[PosedCamera],
    points: Float64[np.ndarray, "P 3"],
) -> Placement:
    """The similarity with the least squares in pixels, from a first one."""
    from scipy.optimize import least_squares

    wanted = np.stack([camera.pixels_of(points) for camera in theirs])
    seen = np.isfinite(wanted) & _inside(wanted, theirs)[..., None]
    pivot = points.mean(axis=0)

    def changed(step: np.ndarray) -> Placement:
        """The first similarity, then a turn, growth and shift about the middle of the points."""
        turn, growth = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[3]))
        scale = first.scale * growth
        shift = pivot + step[4:] - growth * turn @ pivot
        translation = turn @ first.translation + shift / scale
        return Placement(turn @ first.rotation, translation, scale)

    def errors(step: np.ndarray) -> np.ndarray:
        found = np.stack([camera.moved(changed(step)).pixels_of(points) for camera in mine])
        return np.nan_to_num((found - wanted)[seen], nan=1e4)

    reach = _extent(theirs)
    scales = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3 * reach, 1e-3 * reach, 1e-3 * reach])
    step = least_squares(errors, np.zeros(7), x_scale=scales).x
    return changed(step)


def _inside(pixels: Float64[np.ndarray, "N P 2"], cameras: Sequence[PosedCamera]) -> Bool[np.ndarray, "N P"]:
    """Which points lie in the pictures; all of a picture that shows none."""
    sizes = np.array([[c.lens.width, c.lens.height] for c in cameras if c.lens is not None])[:, None]
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((pixels >= 0) & (pixels <= sizes)).all(axis=-1))
    return inside | (inside.sum(axis=1) == 0)[:, None]


def _alignment(
    similarity: Placement,
    names: tuple[str, ...],
    mine: Sequence[PosedCamera],
    theirs: Sequence[PosedCamera],
    points: Float64[np.ndarray, "P 3"],
) -> Alignment:
    aligned = [camera.moved(similarity) for camera in mine]
    wanted = np.stack([camera.pixels_of(points) for camera in theirs])
    squared = ((np.stack([camera.pixels_of(points) for camera in aligned]) - wanted) ** 2).sum(axis=-1)
    squared[~_inside(wanted, theirs)] = np.nan
    found, true = (np.stack([camera.camera_to_world for camera in those]) for those in (aligned, theirs))
    cosines = ((found[:, :, :3] * true[:, :, :3]).sum(axis=(1, 2)) - 1.0) / 2.0
    return Alignment(
        similarity,
        names,
        np.sqrt(np.nanmean(squared, axis=1)),
        np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))),
        np.linalg.norm(found[:, :, 3] - true[:, :, 3], axis=1),
    )


SIMILARITY = Placement(
    Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix(), np.array([1.0, 2.0, -3.0]), 2.5
)


def elsewhere(poses: PoseSet) -> PoseSet:
    back = Placement(
        SIMILARITY.rotation.T,
        -SIMILARITY.scale * SIMILARITY.rotation.T @ SIMILARITY.translation,
        1 / SIMILARITY.scale,
    )
    return replace(poses, cameras={name: camera.moved(back) for name, camera in poses.cameras.items()})


def in_a_row() -> PoseSet:
    cameras = {
        str(x): PosedCamera(np.column_stack([np.eye(3), [x, 0.0, 5.0 + 0.1 * x]]), LENS) for x in range(4)
    }
    return PoseSet(cameras, "a row")
