"""How a line camera moves while it takes one line after the other: from what is known of a stage or a track to one pose
a line, all relative to what is looked at.

A stage that carries the object moves it before a camera that stands still. What counts is where the camera is as the
object sees it, so that the camera goes the other way in the object's world, which is the world of all poses here.

Notation: `H` lines, `n` poses of a track. Poses are camera to world, OpenGL axes: +x along the line, +y up, the camera
looks along -z; what the lines are taken of moves down the picture where +y is against the movement. The pose of a line
holds at the middle of its exposure.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

_Pose = Float64[np.ndarray, "3 4"]
_Vector = Float64[np.ndarray, "3"]
_SQUARE_ENOUGH = 0.05
"""Sine of the angle between a movement and the axis of the camera below which the movement gives no direction for the
line."""


def moved_along(first: _Pose, step: _Vector, num_lines: int) -> Float64[np.ndarray, "H 3 4"]:
    """Poses of a camera that moves by `step` from each line to the next, in units of the world."""
    poses = np.repeat(first[None], num_lines, axis=0)
    poses[:, :, 3] += np.arange(num_lines)[:, None] * step
    return poses


def turned_about(
    first: _Pose, axis: _Vector, centre: _Vector, step_rad: float, num_lines: int
) -> Float64[np.ndarray, "H 3 4"]:
    """Poses of a camera that turns about an axis through `centre` by `step_rad` from each line to the next, counter
    clockwise where the axis points at the viewer."""
    from scipy.spatial.transform import Rotation

    angles = np.arange(num_lines)[:, None] * step_rad
    turns = Rotation.from_rotvec(angles * (axis / np.linalg.norm(axis))).as_matrix()
    rotations = turns @ first[:, :3]
    places = turns @ (first[:, 3] - centre) + centre
    return np.concatenate([rotations, places[:, :, None]], axis=2)


def at_times(
    times_s: Float64[np.ndarray, " n"],
    poses: Float64[np.ndarray, "n 3 4"],
    wanted_s: Float64[np.ndarray, " H"],
) -> Float64[np.ndarray, "H 3 4"]:
    """Poses of a track at other times within it: rotations turn evenly about one axis from pose to pose, positions move
    on straight lines.

    Args:
        times_s: Increasing, at least two.
        wanted_s: None before the first or after the last of the track's.
    """
    from scipy.spatial.transform import Rotation, Slerp

    rotations = Slerp(times_s, Rotation.from_matrix(poses[:, :, :3]))(wanted_s).as_matrix()
    places = np.stack([np.interp(wanted_s, times_s, column) for column in poses[:, :, 3].T], axis=1)
    return np.concatenate([rotations, places[:, :, None]], axis=2)


def looking(position: _Vector, look: _Vector, movement: _Vector, roll_deg: float = 0.0) -> _Pose | None:
    """The pose of a camera that looks along `look` and whose line lies across its movement, so that what passes goes
    down the picture; None where the movement is along the view.

    Args:
        movement: Of the camera against the object, of any length.
        roll_deg: By which the camera is turned about its own axis from there, counter clockwise as it sees itself from
            behind; 180 if columns run the other way.
    """
    back = -look / np.linalg.norm(look)
    across = movement - (movement @ back) * back
    if np.linalg.norm(across) < _SQUARE_ENOUGH * max(np.linalg.norm(movement), 1e-300):
        return None
    up = -across / np.linalg.norm(across)
    right = np.cross(up, back)
    cosine, sine = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    rotated = (cosine * right + sine * up, cosine * up - sine * right)
    return np.column_stack([*rotated, back, position])


def sweep_about(position: _Vector, look: _Vector, axis: _Vector, centre: _Vector) -> _Vector:
    """Along which a camera that turns about an axis sweeps: the way it goes itself, or, where it stands on the axis,
    the way its view goes."""
    way = np.cross(axis, position - centre)
    reach = np.linalg.norm(axis) * np.linalg.norm(position - centre)
    return way if np.linalg.norm(way) > _SQUARE_ENOUGH * reach else np.cross(axis, look)


def averaged_lines(
    poses: Float64[np.ndarray, "H 3 4"], first: int, count: int, binning: int
) -> Float64[np.ndarray, "count 3 4"]:
    """Poses of `count` rows of a picture that are each the mean of `binning` lines, from line `first` on: mean place,
    and the rotation nearest to the mean."""
    blocks = poses[first : first + count * binning].reshape(count, binning, 3, 4).mean(axis=1)
    u, _, vt = np.linalg.svd(blocks[:, :, :3])
    return np.concatenate([u @ vt, blocks[:, :, 3:]], axis=2)


def middle_of(poses: Float64[np.ndarray, "H 3 4"]) -> _Pose:
    """The pose halfway through the picture."""
    height = len(poses)
    return averaged_lines(poses, (height - 1) // 2, 1, 2 - height % 2)[0]
