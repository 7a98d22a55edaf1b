"""Poses of an object that was turned in known steps before a camera that stood still.

One axis explains all views, so few numbers are unknown: how the camera is turned against the axis, its focal length,
and for each further place of the camera where it stood. They follow from two kinds of observations. Matched points of
two views lie on each other's epipolar lines. And where an epipolar plane touches the object, both outlines touch it:
the tangents from the epipoles to the convex hulls of two silhouettes correspond (Wong and Cipolla 2001), whether the
object has texture or not.

The world has the axis as +z; the first camera is 1 away from the axis, at height 0.

Notation: `N` views, `V` corners of a hull, `Q` pairs of views, `F` matches. Camera axes are OpenCV's here, +x right,
+y down, +z forward.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int, UInt8

from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.marker_detection import require_opencv
from unmix_plugin.captures.poses.pose_set import FLIP, PosedCamera, PoseSet
from unmix_plugin.captures.poses.turntable_observations import Observations, Turn, gather
from unmix_plugin.errors import CaptureError

_LEAST_VIEWS = 3
"""Of each place of the camera."""
_SCALE_PX = 1.0
"""Errors beyond count less and less."""
_RIM_PRIOR = 1.0
"""Comparisons of outlines that say that a mask is neither too wide nor too narrow."""
_MOST_ROUGH = (800, 300)
_MOST_FINE = (4000, 2000)
"""Matches and pairs of outlines that are used to begin with, and in the end."""
_SLACK_DEG = 0.5
"""By which angles may be wrong, about, where pictures say so."""
_GAIN, _SLACK_GAIN = 0.02, 0.05
"""Part of the error that distortion, and other angles, have to remove to be kept."""
_LEAST_MATCHES, _LEAST_FIT, _MOST_ALIKE = 30, 0.3, 0.98
"""With fewer matches that fit, or a smaller share, silhouettes have to tell; they can't if they overlap by so much."""
_FITS_PX, _MOST_OFF = 2.0, 0.005
"""Errors of matches that fit; upper quartile of those of outlines, over the diagonal, from which angles are refused."""
_ENOUGH_MATCHES, _ENOUGH_FIT = 300, 0.5
"""So many matches that fit, and such a share, are right whatever the outlines say; with a smaller share, these decide
alone."""
_NOT_COMPARED_PX = 2.0
"""What outlines count that can't be compared in the pose that is tried."""
_MOST_DISTORTION = 0.1
"""Of half the diagonal: what distortion may move the corner of a picture by."""
_PITCH, _AZIMUTH = 1, 4
"""Columns of a place of the camera."""
_FOCAL_FACTORS = (1.2, 2.0, 3.5, 7.0)
_PITCHES_DEG = (0.0, 8.0, 16.0, 24.0, 32.0, 40.0, 48.0, 56.0, 64.0, 72.0)
"""How far the camera may look down, to begin with."""
_STEEPEST = np.radians(85.0)
"""Of a camera at the beginning; straight above, no distance from the axis tells how far away it is."""


def poses_from_turntable(
    pictures: Mapping[str, UInt8[np.ndarray, "H W"]],
    turns: Mapping[str, Turn],
    masks: Mapping[str, Bool[np.ndarray, "H W"]] | None = None,
) -> PoseSet:
    """Where the camera was, as seen from the object.

    Args:
        pictures: By the name of the view, all of one size; with high contrast.
        turns: Of each view. The sense is found, by which cameras look down and not up.
        masks: True on the object; None where it is not known.
    Raises:
        CaptureError: OpenCV is not installed, the views are alike or too few, or the angles do not explain them.
    """
    cv2 = require_opencv()
    names = sorted(pictures, key=lambda name: (turns[name].camera, name))
    counts = np.bincount([turn.camera for turn in turns.values()])
    if counts.min() < _LEAST_VIEWS:
        raise CaptureError(
            f"{counts.min()} views were taken from place {counts.argmin() + 1} of the camera; expected {_LEAST_VIEWS} "
            "or more of each"
        )
    observed = gather(
        cv2,
        [pictures[name] for name in names],
        [turns[name] for name in names],
        None if masks is None else [masks[name] for name in names],
    )
    return poses_from_observations(observed, names)


def poses_from_observations(observed: Observations, names: Sequence[str]) -> PoseSet:
    """The poses that explain what the views of these names show. Raises CaptureError: the views are alike, or the
    angles do not explain them."""
    _refuse_alike(observed, len(observed.first))
    fitted = _fit(observed)
    _refuse_unexplained(fitted, observed)
    return _pose_set(fitted, observed, names)


# Cameras from few numbers, and what of the observations they leave unexplained.


_Poses: TypeAlias = tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, "n 3"]]
"""Axes of cameras in the world, as columns, and where they stand."""


@dataclass(frozen=True)
class _Numbers:
    """What is unknown. Angles in radians."""

    focal_px: float
    sense: float
    """1 where the object turns against the clock as seen from above, -1 with it."""
    cameras: Float64[np.ndarray, "C 6"]
    """Of each place: yaw, pitch and roll, logarithm of the distance from the axis, azimuth, height."""
    slack: Float64[np.ndarray, " N"]
    """To add to the angles."""
    k1: float = 0.0

    def poses(self, observed: Observations) -> _Poses:
        """Axes of all cameras in the world, as columns, and where they stand."""
        from scipy.spatial.transform import Rotation

        yaw, pitch, roll, distance, azimuth, height = self.cameras[observed.camera].T
        inward = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # azimuth 0, to the axis
        turned = Rotation.from_euler("yxz", np.column_stack([yaw, -pitch, roll])).as_matrix()
        about = azimuth - self.sense * (observed.angle + self.slack)
        swing = Rotation.from_euler("z", about[:, None]).as_matrix()
        reach = np.exp(distance)
        places = np.column_stack([reach * np.cos(about), reach * np.sin(about), height])
        return swing @ inward @ turned, places

    def ideal(
        self, pixels: Float64[np.ndarray, "*n 2"], size: tuple[int, int]
    ) -> Float64[np.ndarray, "*n 3"]:
        """Directions of pixels before the camera, 1 forward."""
        distorted = (pixels - np.array(size) / 2) / self.focal_px
        ideal = distorted
        for _ in range(4 if self.k1 else 0):
            ideal = distorted / (1.0 + self.k1 * (ideal**2).sum(axis=-1, keepdims=True))
        return np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)

    def errors(
        self, observed: Observations, ahead: float = 0.0, rims: bool = True
    ) -> tuple[Float64[np.ndarray, " F"], Float64[np.ndarray, "Q 4"]]:
        """Distances of matched points from epipolar lines, and of outlines from tangents, pixels; with the first view
        of each pair turned `ahead` by so much. `rims`: less what comes of masks that are too wide or too narrow."""
        second = self.poses(observed)
        first = replace(self, slack=self.slack + ahead).poses(observed) if ahead else second
        return (
            self.focal_px * _epipolar(self.ideal(observed.points, observed.size), observed, first, second),
            _tangential(self, observed, first, second, rims),
        )

    def cost(self, observed: Observations) -> float:
        """Mean of the robust errors."""
        errors = np.concatenate([part.ravel() for part in self.errors(observed)])
        return float(np.mean(np.log1p((errors / _SCALE_PX) ** 2)))


def _essential(first: _Poses, second: _Poses) -> Float64[np.ndarray, "P 3 3"]:
    """Matrices that take directions in the first views to their epipolar lines in the second."""
    into = second[0].transpose(0, 2, 1)
    x, y, z = (into @ (first[1] - second[1])[..., None])[..., 0].T
    cross = np.zeros((len(x), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    return (cross - cross.transpose(0, 2, 1)) @ into @ first[0]


def _epipolar(
    ideal: Float64[np.ndarray, "F 2 3"], observed: Observations, first: _Poses, second: _Poses
) -> Float64[np.ndarray, " F"]:
    """Distances of matched points from each other's epipolar lines, over the focal length (Sampson 1982)."""
    i, j = observed.first, observed.second
    essential = _essential((first[0][i], first[1][i]), (second[0][j], second[1][j]))
    there = (essential @ ideal[:, 0, :, None])[..., 0]
    back = (essential.transpose(0, 2, 1) @ ideal[:, 1, :, None])[..., 0]
    slope = np.sqrt((there[:, :2] ** 2).sum(axis=-1) + (back[:, :2] ** 2).sum(axis=-1))
    return (there * ideal[:, 1]).sum(axis=-1) / np.maximum(slope, 1e-12)


def _tangential(
    numbers: _Numbers, observed: Observations, first: _Poses, second: _Poses, rims: bool
) -> Float64[np.ndarray, "Q 4"]:
    """How far outlines reach beyond the tangents of the others, pixels; what can't be compared counts as off."""
    if not len(observed.touched):
        return np.zeros((0, 4))
    i, j = observed.touched.T
    essential = _essential((first[0][i], first[1][i]), (second[0][j], second[1][j]))
    ideal = numbers.ideal(observed.hulls, observed.size)
    middles = ((ideal.min(axis=1) + ideal.max(axis=1)) / 2)[:, None]
    inside = np.all((observed.hulls > 1.0) & (observed.hulls < np.array(observed.size) - 1.0), axis=-1)
    ends_i, out_i = _touching(ideal, middles, i, first[0][i], second[1][j] - first[1][i])
    ends_j, out_j = _touching(ideal, middles, j, second[0][j], first[1][i] - second[1][j])
    touch_i, touch_j = ideal[i[:, None], ends_i], ideal[j[:, None], ends_j]
    good_i, good_j = out_i[:, None] & inside[i[:, None], ends_i], out_j[:, None] & inside[j[:, None], ends_j]
    lines_j, lines_i = touch_i @ essential.transpose(0, 2, 1), touch_j @ essential

    def beyond(lines: np.ndarray, points: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """How far points lie outside of lines, as seen from the middle of a hull."""
        length = np.maximum(np.hypot(lines[..., 0], lines[..., 1]), 1e-12)
        return -np.sign((lines * middle).sum(axis=-1)) * (lines * points).sum(axis=-1) / length

    # Which tangent belongs to which depends on the sides that the epipoles lie on.
    either = [
        (beyond(lines_i[:, ::order], touch_i, middles[i]), beyond(lines_j, touch_j[:, ::order], middles[j]))
        for order in (1, -1)
    ]
    size = [(np.abs(of_i) + np.abs(of_j)).sum(axis=1) for of_i, of_j in either]
    straight = (size[0] <= size[1])[:, None]
    of_i, of_j = (np.where(straight, either[0][part], either[1][part]) for part in (0, 1))
    good = good_i & np.where(straight, good_j, good_j[:, ::-1])
    of_i, of_j = numbers.focal_px * of_i, numbers.focal_px * of_j
    if rims:
        of_i, of_j = _without_rims(of_i, of_j, good, observed)
    found = np.where(np.tile(good, 2), np.concatenate([of_i, of_j], axis=1), _NOT_COMPARED_PX)
    return np.asarray(found)


def _touching(
    ideal: Float64[np.ndarray, "N V 3"],
    middles: Float64[np.ndarray, "N 1 3"],
    views: Int[np.ndarray, " Q"],
    axes: Float64[np.ndarray, "Q 3 3"],
    towards: Float64[np.ndarray, "Q 3"],
) -> tuple[Int[np.ndarray, "Q 2"], Bool[np.ndarray, " Q"]]:
    """Which corners of the views' hulls tangents from the epipoles touch, and whether these lie outside the hulls; with
    the axes of the views, and the way to the others."""
    epipole = (towards[:, None] @ axes)[:, 0]
    depth = np.where(np.abs(epipole[:, 2]) < 1e-6, 1e-6, epipole[:, 2])
    place = epipole[:, None, :2] / depth[:, None, None]
    ahead, rays = middles[views, :, :2] - place, ideal[views, :, :2] - place
    along = ahead[..., 0] * rays[..., 0] + ahead[..., 1] * rays[..., 1]
    across = ahead[..., 0] * rays[..., 1] - ahead[..., 1] * rays[..., 0]
    slope = across / np.where(along > 0, along, np.inf)
    is_outside = np.asarray((along > 0).all(axis=1))
    return np.stack([slope.argmin(axis=1), slope.argmax(axis=1)], axis=1), is_outside


def _without_rims(
    of_i: Float64[np.ndarray, "Q 2"],
    of_j: Float64[np.ndarray, "Q 2"],
    good: Bool[np.ndarray, "Q 2"],
    observed: Observations,
) -> tuple[Float64[np.ndarray, "Q 2"], Float64[np.ndarray, "Q 2"]]:
    """Distances less what comes of masks that are too wide or too narrow, each by a length of its own."""
    i, j = observed.touched.T
    beyond = 0.5 * (of_i - of_j)
    weights = good / (1.0 + (beyond / _SCALE_PX) ** 2)
    weight, total = weights.sum(axis=1), (weights * beyond).sum(axis=1)
    table, wanted = _RIM_PRIOR * np.eye(len(observed.angle)), np.zeros(len(observed.angle))
    for rows, columns, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(table, (rows, columns), sign * weight)
    np.add.at(wanted, i, total)
    np.add.at(wanted, j, -total)
    rims = np.linalg.solve(table, wanted)
    apart = (rims[i] - rims[j])[:, None]
    return of_i - apart, of_j + apart


# The fit.


def _solve(
    start: _Numbers,
    observed: Observations,
    which: Sequence[int],
    steps: int,
    zoom: bool = True,
    distorted: bool = False,
    slack: bool = False,
) -> _Numbers:
    """Least squares over some places of the camera, the first of which holds the world in place; and over the focal
    length (zoom), k1 (distorted) and the angles (slack) where asked."""
    from scipy.optimize import least_squares

    free = np.zeros(start.cameras.shape, bool)
    free[list(which)] = True
    free[which[0], 3:] = False
    few = int(zoom) + int(distorted) + int(free.sum())
    size = np.concatenate([[0.1] * (int(zoom) + int(distorted)), np.full(free.sum(), 0.05)])
    views = len(start.slack) if slack else 0

    def numbers_of(values: np.ndarray) -> _Numbers:
        cameras, angles = start.cameras.copy(), start.slack.copy()
        cameras[free] += values[int(zoom) + int(distorted) : few]
        angles[: len(values) - few] += values[few:]
        focal = start.focal_px * float(np.exp(values[0])) if zoom else start.focal_px
        k1 = start.k1 + (float(values[int(zoom)]) if distorted else 0.0)
        return replace(start, focal_px=focal, cameras=cameras, slack=angles, k1=k1)

    def flat(numbers: _Numbers, **changes: Any) -> np.ndarray:
        return np.concatenate([part.ravel() for part in numbers.errors(observed, **changes)])

    def errors(values: np.ndarray) -> np.ndarray:
        return np.append(flat(numbers_of(values)), values[few:] / np.radians(_SLACK_DEG))

    def slopes(values: np.ndarray) -> np.ndarray:
        """Differences; angles act through those of pairs alone, so that one more evaluation gives all of them."""
        now = flat(numbers_of(values))
        result = np.zeros((len(now) + views, few + views))
        for column, length in enumerate(1e-4 * size):
            ahead = flat(numbers_of(values + length * (np.arange(len(values)) == column)))
            result[: len(now), column] = (ahead - now) / length
        if slack:
            numbers = numbers_of(values)  # rims, which all pairs share, are taken to stay
            by_turn = (flat(numbers, ahead=1e-5, rims=False) - flat(numbers, rims=False)) / 1e-5
            rows, four = np.arange(len(now)), np.repeat(observed.touched, 4, axis=0)
            ends = np.concatenate([np.column_stack([observed.first, observed.second]), four])
            result[rows, few + ends[:, 0]] = by_turn
            result[rows, few + ends[:, 1]] = -by_turn
            result[len(now) + np.arange(views), few + np.arange(views)] = 1.0 / np.radians(_SLACK_DEG)
        return result

    scales = np.append(size, np.full(views, 0.005))
    found = least_squares(
        errors,
        np.zeros(len(scales)),
        jac=slopes,  # type: ignore[arg-type]
        x_scale=scales,
        loss="cauchy",
        f_scale=_SCALE_PX,
        max_nfev=steps,
    )
    return numbers_of(found.x)


def _fit(observed: Observations) -> _Numbers:
    """The numbers that explain the observations best, from beginnings of many focal lengths and both senses."""
    rough, fine = observed.thinned(_MOST_ROUGH), observed.thinned(_MOST_FINE)
    longer, everyone = max(observed.size), range(int(observed.camera.max()) + 1)
    ends = []
    for sense in (1.0, -1.0):
        begun = [_begin(rough, factor * longer, sense) for factor in _FOCAL_FACTORS]
        begun.sort(key=lambda start: start.cost(rough))
        tried = [_solve(start, rough, everyone, steps=15) for start in begun[:2]]
        ends.append(min(tried, key=lambda found: found.cost(rough)))
    # From far away, turning the other way and looking up from below gives the same outlines.
    costs = [end.cost(rough) for end in ends]
    looks_down = [-float(end.cameras[:, 1].mean()) for end in ends]
    is_unclear = abs(costs[0] - costs[1]) < _GAIN * max(costs)
    best = ends[int(np.argmin(looks_down if is_unclear else costs))]
    best = _solve(best, fine, everyone, steps=40)
    fits = np.abs(best.errors(fine)[0]) < _FITS_PX
    if len(fits) and fits.mean() < _ENOUGH_FIT and len(fine.touched) and observed.likeness <= _MOST_ALIKE:
        none = observed.first[:0]
        # On plain things most matches are chance, such as highlights, and would pull the cameras with them.
        return _fit(replace(observed, first=none, second=none, points=observed.points[:0]))
    distorted = _solve(best, fine, everyone, steps=20, distorted=True)
    # By how much of half the diagonal distortion moves the corners of a picture.
    moved = abs(distorted.k1) * (np.hypot(*observed.size) / 2 / distorted.focal_px) ** 2
    if distorted.cost(fine) < (1.0 - _GAIN) * best.cost(fine) and moved < _MOST_DISTORTION:
        best = distorted
    loose = _solve(best, fine, everyone, steps=20, distorted=bool(best.k1), slack=True)
    return loose if loose.cost(fine) < (1.0 - _SLACK_GAIN) * best.cost(fine) else best


def _begin(observed: Observations, focal_px: float, sense: float) -> _Numbers:
    """All places of the camera at one distance from a point of the axis, each turned as its own views have it."""
    count = int(observed.camera.max()) + 1
    start = _Numbers(focal_px, sense, np.zeros((count, 6)), np.zeros(len(observed.angle)))

    def best_of(camera: int, column: int, degrees: Sequence[float], those: Observations) -> None:
        def cost(value: float) -> float:
            start.cameras[camera, column] = value
            return start.cost(those)

        start.cameras[camera, column] = min(np.radians(degrees).tolist(), key=cost)

    for camera in range(count):
        at_place = observed.part(observed.camera == camera)
        best_of(camera, _PITCH, _PITCHES_DEG, at_place)
        start.cameras[camera, :3] = _solve(start, at_place, [camera], steps=8, zoom=False).cameras[camera, :3]
    # Angles that are wrong may turn a camera over; what then fits badly is refused.
    pitch = np.clip(start.cameras[:, _PITCH], -_STEEPEST, _STEEPEST)
    start.cameras[:, _PITCH] = pitch
    distance = 1.0 / np.cos(pitch[0])
    start.cameras[:, 3] = np.log(distance * np.cos(pitch))
    start.cameras[:, 5] = distance * (np.sin(pitch) - np.sin(pitch[0]))
    for camera in range(1, count):
        pair = observed.part((observed.camera == camera) | (observed.camera == 0))
        best_of(camera, _AZIMUTH, np.arange(0.0, 360.0, 10.0).tolist(), pair)
    return start


# What is refused, and the result.


def _refuse_alike(observed: Observations, fits: int) -> None:
    """Refuse views whose silhouettes tell nothing, where too few matches fit to tell it instead."""
    if observed.likeness <= _MOST_ALIKE or fits >= max(_LEAST_MATCHES, _LEAST_FIT * len(observed.first)):
        return
    has_masks = len(observed.touched) > 0
    silhouettes = f"silhouettes overlap by {observed.likeness:.1%}" if has_masks else "there are no masks"
    raise CaptureError(
        f"the axis can't be told, as all views are alike: {silhouettes}, and {fits} of {len(observed.first)} points "
        "that were matched and moved fit one; put something patterned on the turntable, or cut out the background"
    )


def _refuse_unexplained(fitted: _Numbers, observed: Observations) -> None:
    matched, outlines = fitted.errors(observed)
    fits = int((np.abs(matched) < _FITS_PX).sum())
    _refuse_alike(observed, fits)
    compared = np.abs(outlines[outlines != _NOT_COMPARED_PX])
    off = float(np.percentile(compared, 75)) if len(compared) else np.inf
    limit = _MOST_OFF * float(np.hypot(*observed.size))
    if off <= limit or fits >= max(_ENOUGH_MATCHES, _ENOUGH_FIT * len(matched)):
        return
    outlines_off = (
        f"a quarter of the outlines are off by more than {off:.2g} px (at most {limit:.2g} is expected), "
    )
    raise CaptureError(
        f"the angles do not explain the pictures: {outlines_off * bool(len(compared))}{fits} of {len(matched)} "
        "matched points fit; expected the object alone to turn before a camera and a background that stand still: "
        "check --angles, and that --mask cuts out the object"
    )


def _pose_set(fitted: _Numbers, observed: Observations, names: Sequence[str]) -> PoseSet:
    axes, places = fitted.poses(observed)
    width, height = observed.size
    focal = (fitted.focal_px, fitted.focal_px)
    lens = Lens(width, height, focal, (width / 2, height / 2), (fitted.k1, 0.0, 0.0, 0.0))
    cameras = {
        name: PosedCamera(np.column_stack([axes[index] @ FLIP, places[index]]), lens)
        for index, name in enumerate(names)
    }
    matched, outlines = (np.abs(part) for part in fitted.errors(observed))
    compared = outlines[outlines != _NOT_COMPARED_PX]
    off = f", outlines are off by {np.median(compared):.2f} px in the median" if len(compared) else ""
    fits = f"{int((matched < _FITS_PX).sum())} of {len(matched)} matched points fit"
    down = ", ".join(f"{np.degrees(pitch):.1f}" for pitch in fitted.cameras[:, _PITCH])
    sense = "against" if fitted.sense > 0 else "with"
    notes = [
        f"the turntable gave poses of {len(names)} of {len(names)} views: {fits}{off}",
        f"focal length estimated from the turning: {fitted.focal_px:.1f} px; the camera looks down by {down} degrees",
        f"the object turned {sense} the clock, seen from above",
    ]
    if fitted.slack.any():
        notes.append(f"angles were corrected by up to {np.degrees(np.abs(fitted.slack).max()):.2f} degrees")
    up = np.array([0.0, 0.0, 1.0])
    return PoseSet(dict(sorted(cameras.items())), "a turntable", up=up, has_world=False, notes=tuple(notes))
