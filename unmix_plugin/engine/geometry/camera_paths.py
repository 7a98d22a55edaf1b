"""Where cameras stand and look: paths around a scene and through its cameras, the point that cameras look at, and
upright cameras for built-in scenes.

Notation: `N` cameras, `F` frames. Poses are camera to world, OpenGL axes: their columns are right, up and back; a
camera looks along minus back.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import ConfigError

_WIDEST_GAP_DEG = 120.0
"""Directions that no camera looks from, beyond which a circle becomes an arc: behind them there may be walls."""

_SMALLEST_SWING_DEG = 10.0
"""Half of the shortest arc, so that there is something to see."""

_NEAR = 0.05
"""Part of a length below which a direction is no longer reliable."""

_STEEPEST_DEG = 80.0
"""Greatest elevation of a circle, near which its cameras would only spin."""


def orbit(cameras: Cameras, box: SceneBox, num_frames: int) -> Cameras:
    """A circle of `num_frames` cameras with the middle lens of the given ones, around what these look at, at their
    middle distance and elevation; its centre lies in the box, and it ends where it starts.

    Where the cameras are on one side only, it is an arc over that side, back and forth.
    """
    poses = cameras.camera_to_world.double().cpu().numpy()
    centre, up = _looked_at(poses, box.aabb.double().cpu().numpy()), _upwards(poses)
    away = poses[:, :, 3] - centre
    height = away @ up
    elevation = np.median(np.arctan2(height, np.linalg.norm(away - height[:, None] * up, axis=1)))
    elevation = np.clip(elevation, -np.deg2rad(_STEEPEST_DEG), np.deg2rad(_STEEPEST_DEG))
    first, second = _ground_axes(up)
    angles = _swing(np.arctan2(away @ second, away @ first), num_frames)
    outward = np.cos(elevation) * (np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second)
    distance = np.median(np.linalg.norm(away, axis=1))
    backs = outward + np.sin(elevation) * up
    return _with_lens(cameras, _upright(centre + distance * backs, _unit(backs), up))


def interpolated(cameras: Cameras, box: SceneBox, num_frames: int) -> Cameras:
    """A smooth path of `num_frames` cameras with the middle lens of the given ones, through these, each the nearest of
    those left; from the first to the last at even speed.

    Between two cameras the path bends around what all look at, and does not cut through it. Raises ConfigError: there
    are no two different cameras.
    """
    poses, lengths = _tour(cameras.camera_to_world.double().cpu().numpy())
    if len(poses) < 2:
        raise ConfigError(
            "a path through cameras needs at least two different ones; choose --cameras orbit instead"
        )
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, along[-1], num_frames)
    centre = _looked_at(poses, box.aabb.double().cpu().numpy())
    path = _path_around(centre, poses, along, at)
    return _with_lens(cameras, _straight_path(poses, along, at) if path is None else path)


def _looked_at(
    poses: Float64[np.ndarray, "N 3 4"], aabb: Float64[np.ndarray, "2 3"]
) -> Float64[np.ndarray, "3"]:
    """The point of the box nearest to all optical axes, in the sense of least squares."""
    across = _across(poses)
    # Parallel axes leave the depth open: a little pull towards the middle of the box decides it.
    pull = 1e-3 * len(poses)
    wanted = (across @ poses[:, :, 3:]).sum(axis=0)[:, 0] + pull * aabb.mean(axis=0)
    return np.clip(np.linalg.solve(across.sum(axis=0) + pull * np.eye(3), wanted), aabb[0], aabb[1])


def _upwards(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "3"]:
    """The direction to which all cameras' right is perpendicular, as it is where nobody tilts the horizon."""
    rights, mean_up = poses[:, :, 0], poses[:, :, 1].mean(axis=0)
    mean_up = mean_up / max(float(np.linalg.norm(mean_up)), 1e-9)
    # Cameras side by side leave a plane of such directions: a little pull towards their own up decides.
    pull = 1e-5 * len(poses) * (np.eye(3) - np.outer(mean_up, mean_up))
    up = np.linalg.eigh(rights.T @ rights + pull)[1][:, 0]
    return up if up @ mean_up >= 0 else -up


def _ground_axes(
    up: Float64[np.ndarray, "3"],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Two unit vectors perpendicular to up and to each other; seen from above the second is left of the first."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def _swing(angles: Float64[np.ndarray, "N"], num_frames: int) -> Float64[np.ndarray, "F"]:
    """Angles in radians of a full circle, or back and forth over the arc on which the cameras are."""
    turn = np.arange(num_frames) / num_frames * 2 * np.pi
    ordered = np.sort(angles)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] <= np.deg2rad(_WIDEST_GAP_DEG):
        return ordered[0] + turn
    start = ordered[(widest + 1) % len(ordered)]
    half = max((2 * np.pi - gaps[widest]) / 2, np.deg2rad(_SMALLEST_SWING_DEG))
    return start + (2 * np.pi - gaps[widest]) / 2 + half * np.sin(turn)


def _upright(
    positions: Float64[np.ndarray, "F 3"], backs: Float64[np.ndarray, "F 3"], ups: Float64[np.ndarray, "*F 3"]
) -> Float64[np.ndarray, "F 3 4"]:
    """Poses at these positions that look against unit vectors, tilted so that right is square to up."""
    rights = _unit(np.cross(ups, backs))
    return np.stack([rights, np.cross(backs, rights), backs, positions], axis=2)


def _path_around(
    centre: Float64[np.ndarray, "3"],
    poses: Float64[np.ndarray, "N 3 4"],
    along: Float64[np.ndarray, "N"],
    at: Float64[np.ndarray, "F"],
) -> Float64[np.ndarray, "F 3 4"] | None:
    """Poses that change smoothly about a centre; None where the path meets it, or what it looks at."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    away, backs = poses[:, :, 3] - centre, poses[:, :, 2]
    distances = np.linalg.norm(away, axis=1)
    # On each axis the point nearest to the centre, or one in front of a camera that looks elsewhere.
    ahead = np.maximum((away * backs).sum(axis=1), 0.2 * distances.mean())
    gazes = CubicSpline(along, away - ahead[:, None] * backs)(at)
    outward, ups = CubicSpline(along, away)(at), CubicSpline(along, poses[:, :, 1])(at)
    if np.linalg.norm(outward, axis=1).min() < _NEAR * distances.min():
        return None
    # Distances stay between those of neighbours: a spline swings past a near camera, through the centre.
    positions = PchipInterpolator(along, distances)(at)[:, None] * _unit(outward)
    backs, ups = positions - gazes, _unit(ups)
    is_close = np.linalg.norm(backs, axis=1).min() < _NEAR * ahead.min()
    if is_close or np.linalg.norm(np.cross(ups, _unit(backs)), axis=1).min() < _NEAR:
        return None
    return _upright(positions + centre, _unit(backs), ups)


def _straight_path(
    poses: Float64[np.ndarray, "N 3 4"], along: Float64[np.ndarray, "N"], at: Float64[np.ndarray, "F"]
) -> Float64[np.ndarray, "F 3 4"]:
    """Poses between poses: positions by a spline, rotations by the shortest turns."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    rotations = Slerp(along, Rotation.from_matrix(poses[:, :, :3]))(at).as_matrix()
    return np.concatenate([rotations, CubicSpline(along, poses[:, :, 3])(at)[:, :, None]], axis=2)


def _unit(vectors: Float64[np.ndarray, "F 3"]) -> Float64[np.ndarray, "F 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _tour(
    poses: Float64[np.ndarray, "N 3 4"],
) -> tuple[Float64[np.ndarray, "M 3 4"], Float64[np.ndarray, " steps"]]:
    """The poses from the first on, each followed by the nearest of those left, and the lengths of the steps."""
    reach = float(np.ptp(poses[:, :, 3], axis=0).max()) or 1.0
    order, lengths, left = [0], [], list(range(1, len(poses)))
    while left:
        # A step has the length of its way and, if it only turns, of its turn.
        differences = poses[left] - poses[order[-1]]
        steps = np.linalg.norm(differences[:, :, 3], axis=1)
        steps = steps + 0.1 * reach * np.linalg.norm(differences[:, :, :3], axis=(1, 2))
        nearest = int(steps.argmin())
        following = left.pop(nearest)
        if steps[nearest] > 1e-6 * reach:
            order.append(following)
            lengths.append(steps[nearest])
    return poses[order], np.array(lengths)


def _with_lens(cameras: Cameras, poses: Float[np.ndarray, "F 3 4"]) -> Cameras:
    """Pinhole cameras at these poses, with the middle lens of `cameras`."""
    cameras = cameras.one_size()
    return _pinholes(poses, cameras.focal_px.cpu().median(dim=0).values, cameras.width, cameras.height)


def _pinholes(
    poses: Float[np.ndarray, "F 3 4"], focal_px: Float[torch.Tensor, "2"], width: int, height: int
) -> Cameras:
    """Cameras of one lens whose axis meets the middle of the picture."""
    ones = torch.ones(len(poses), 1)
    middle = torch.tensor([width / 2, height / 2])
    matrices = torch.tensor(poses, dtype=torch.float32)
    return Cameras(matrices, ones * focal_px, ones * middle, ones * torch.zeros(4), width, height)


_LEAST_CONVERGENCE = 1e-3
"""Least mean squared sine between optical axes and the direction that they spread from least, (1.8 deg)^2, with which
the nearest point is fixed at all."""


_LEAST_SPREAD_DEG = 6.0
"""Root mean square of that angle for cameras turned about a subject; a flight whose camera sways has less."""

_MOST_MISSED = 0.25
"""By how much half of the axes may miss the point, over their depth there."""


def nearest_to_axes(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "3"]:
    """The point nearest to all optical axes, least squares; of parallel axes the one nearest to the origin, too."""
    across = _across(poses)
    return np.linalg.pinv(across.mean(axis=0)) @ (across @ poses[:, :, 3:]).mean(axis=0)[:, 0]


def focus_point(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "3"] | None:
    """The point nearest to all optical axes, least squares; None if they are parallel or most point away from it."""
    if _convergence(poses) < _LEAST_CONVERGENCE:
        return None
    point = nearest_to_axes(poses)
    depths = ((point - poses[:, :, 3]) * -poses[:, :, 2]).sum(axis=-1)
    return point if (depths > 0.0).mean() > 0.5 else None


def meeting_point(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "3"] | None:
    """That point where the axes meet well enough to say that the subject is there, otherwise None.

    They do not where cameras look down on land from an aircraft, side by side at something flat, or around themselves.
    """
    point = focus_point(poses)
    if point is None or _convergence(poses) < np.sin(np.radians(_LEAST_SPREAD_DEG)) ** 2:
        return None
    towards, forward = point - poses[:, :, 3], -poses[:, :, 2]
    depths = (towards * forward).sum(axis=-1)
    missed = np.linalg.norm(towards - depths[:, None] * forward, axis=-1)
    return point if np.median(missed / np.abs(depths).clip(min=1e-12)) <= _MOST_MISSED else None


def _across(poses: Float64[np.ndarray, "N 3 4"]) -> Float64[np.ndarray, "N 3 3"]:
    """Projections of space to what is square to each optical axis."""
    axes = poses[:, :, 2]
    return np.eye(3) - axes[:, :, None] * axes[:, None, :]


def _convergence(poses: Float64[np.ndarray, "N 3 4"]) -> float:
    return float(np.linalg.eigvalsh(_across(poses).mean(axis=0))[0])


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
    focal_px = torch.full((2,), float(size / 2 / np.tan(angle / 2)))
    return _pinholes(_upright(positions, backward, np.array([0.0, 0.0, 1.0])), focal_px, size, size)
