"""Poses from printed markers: a map of the markers and all cameras, by bundle adjustment of the markers' corners.

Every marker is a square of one size that lies anywhere; boards need no description. The map begins with the marker
that most views show. One square alone has two poses that look nearly alike (Collins and Bartoli 2014), so each further
marker is put where the views that see it beside known ones agree. Focal lengths that are not given are first tried in
steps.

The world of the result stands on the plane that most markers lie in: +z is up, away from the printed side.

Notation: `S` sightings of a marker in a view, `N` views, `M` markers. Transforms are 4 x 4, `a_from_b` takes
coordinates of b to those of a; camera axes are OpenCV's here, +x right, +y down, +z forward.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.marker_detection import Sightings, require_opencv
from unmix_plugin.captures.poses.marker_map import (
    SQUARE,
    MarkerMap,
    Seen,
    Transforms,
    solve,
    transformed,
)
from unmix_plugin.captures.poses.pose_set import FLIP, PosedCamera, PoseSet, where_rays_meet
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.scenes.placement import Placement

_LEAST_VIEWS = 3
_FOCAL_FACTORS = (0.7, 1.0, 1.5, 2.3, 3.5, 6.0, 11.0)
"""First focal lengths to try, over the longer side."""
_WORST_PX = 20.0
"""Misses count no more than this while the map is begun."""
_OUTLIER_PX, _OUTLIER_FACTOR = 1.5, 5.0
"""Root mean square over a sighting's corners from which it is left out, and at least so many times the median."""
_MOST_LEFT_OUT = 0.25
"""Share of the sightings that may be left out; beyond, the markers are no rigid thing."""
_MOST_OFF_PX, _MOST_OFF = 1.5, 5e-4
"""Median error of sightings, or over the diagonal, from which the markers are no rigid thing either."""
_SIZE_TOLERANCE = 0.1
"""By which markers may seem larger or smaller than the others, as a share."""
_GAIN = 0.02
"""Part of the reprojection error that distortion has to remove to be kept."""
_CLEAR = 3.0
"""How many times better one of a single marker's two poses has to fit to be taken."""
_ONE_PLANE = np.cos(np.radians(10.0))
"""Between normals of markers that lie in one plane."""


def poses_from_markers(
    sightings: Sightings,
    sensor_of: Mapping[str, str],
    lenses: Mapping[str, Lens | tuple[int, int]],
    marker_size: float | None = None,
) -> PoseSet:
    """Where pictures were taken from, by the markers in them.

    Args:
        sightings: Markers of every view; views without any count as not posed.
        sensor_of: Sensor of each view; views of one have one lens.
        lenses: By sensor, where they are known; otherwise width and height of its pictures, and they are estimated.
        marker_size: Side of a marker, metres; without it 1 is the side of a marker.
    Raises:
        CaptureError: OpenCV is not installed, fewer than three views see markers that belong together, the markers
            have several sizes, or they moved against each other.
    """
    require_opencv()
    sensors = sorted({sensor_of[name] for name in sightings})
    given = [lenses[sensor] for sensor in sensors]
    seen, folded = _gather(sightings, {name: sensors.index(sensor_of[name]) for name in sightings}, given)
    first = [
        lens if isinstance(lens, Lens) else Lens(*lens, (0.0, 0.0), (lens[0] / 2, lens[1] / 2))
        for lens in given
    ]
    free = np.array([not isinstance(lens, Lens) and i in seen.sensor for i, lens in enumerate(given)])
    found, kept = _adjust(_begin(seen, first, free), seen, free)
    _refuse_several_sizes(found, seen, kept)
    found = replace(found, sizes=np.ones(len(found.sizes)))
    found, kept = _adjust(found, seen, free, same_size=True)
    _refuse_moved(found, seen, kept)
    if free.any():  # k1 and k2 are estimated too, where that is better
        part = seen.part(kept)
        distorted = solve(found, part, free, same_size=True, with_distortion=True)
        before, after = (float(np.sqrt(np.mean(one.misses(part) ** 2))) for one in (found, distorted))
        found = distorted if after < (1.0 - _GAIN) * before else found
    poses = _pose_set(found, seen, kept, sightings, marker_size, free)
    return replace(poses, notes=(*poses.notes, folded)) if folded else poses


def _gather(
    sightings: Sightings, sensor_of: Mapping[str, int], lenses: Sequence[Lens | tuple[int, int]]
) -> tuple[Seen, str]:
    """Sightings of markers that at least two views have, at least three views of them; and what is left out, as known
    lenses can't follow it."""
    followed: Sightings = {}
    for name, markers in sightings.items():
        lens, followed[name] = lenses[sensor_of[name]], {}
        for number, corners in markers.items():
            if not isinstance(lens, Lens) or lens.ideal_of(corners) is not None:
                followed[name][number] = corners
    lost = sum(len(markers) - len(followed[name]) for name, markers in sightings.items())
    left_out = f"{counted(lost, 'sighting')} of markers left out where a lens folds its picture over"
    views_of = Counter(number for markers in followed.values() for number in markers)
    shared = {number for number, count in views_of.items() if count > 1}
    views = [name for name, markers in followed.items() if shared & set(markers)]
    if len(views) < _LEAST_VIEWS:
        alone = sum(bool(markers) for markers in followed.values())
        raise CaptureError(
            f"markers are seen in {alone} of {len(sightings)} views, the same ones in {len(views)}; expected at least "
            f"{_LEAST_VIEWS}: take the board into every picture, larger or sharper, or give --poses estimate"
            + f" ({left_out}: calibrate it again)"
            * (lost > 0)
        )
    numbers = sorted(shared)
    rows = [
        (index, numbers.index(number), corners)
        for index, name in enumerate(views)
        for number, corners in followed[name].items()
        if number in shared
    ]
    view, marker, corners = (np.array(column) for column in zip(*rows, strict=True))
    sensors = np.array([sensor_of[name] for name in views])
    seen = Seen(tuple(views), tuple(numbers), view, marker, corners, sensors)
    return seen, left_out if lost else ""


# The map's beginning: poses of single squares, and what they agree on.


def _begin(seen: Seen, lenses: Sequence[Lens], free: Bool[np.ndarray, " L"]) -> MarkerMap:
    """A map with the focal length that explains the corners best."""
    begun: list[tuple[float, float, MarkerMap]] = []
    for factor in _FOCAL_FACTORS if free.any() else (1.0,):
        tried = tuple(
            replace(lens, focal_px=(factor * max(lens.width, lens.height),) * 2) if is_free else lens
            for lens, is_free in zip(lenses, free, strict=True)
        )
        start = _Chain(seen, tried).grow()
        misses = start.misses(seen)
        usable = np.isfinite(misses)
        if usable.sum() >= _LEAST_VIEWS:
            begun.append((float(usable.mean()), float(np.minimum(misses[usable], _WORST_PX).mean()), start))
    if not begun:
        raise CaptureError(
            "the markers of the views do not belong together; take several of them, the whole board, into every picture"
        )
    most = max(share for share, _, _ in begun)
    ranked = sorted((miss, index) for index, (share, miss, _) in enumerate(begun) if share > 0.95 * most)
    tried_out = [_adjust(begun[index][2], seen, free, steps=15)[0] for _, index in ranked[:3]]

    def robust_cost(found: MarkerMap) -> float:
        misses = found.misses(seen)
        usable = np.isfinite(misses)
        return float(np.minimum(misses[usable], _WORST_PX).mean() / usable.mean())

    return min(tried_out, key=robust_cost)


class _Chain:
    """A map that grows marker by marker, each put where the views that see it beside known ones agree."""

    def __init__(self, seen: Seen, lenses: tuple[Lens, ...]) -> None:
        self._seen, self._lenses = seen, lenses
        self._focal = np.array([lens.focal_px[0] for lens in lenses])[seen.sensor][seen.view]
        self._ideal = np.empty_like(seen.corners)
        for index in np.unique(seen.sensor[seen.view]).tolist():
            of_sensor = seen.sensor[seen.view] == index
            ideal = lenses[index].ideal_of(seen.corners[of_sensor].reshape(-1, 2))
            assert ideal is not None  # `_gather` leaves out what a lens can't follow
            self._ideal[of_sensor] = ideal.reshape(-1, 4, 2)
        self._squares = np.stack([_square_poses(corners) for corners in self._ideal])
        """Both poses of each sighting, camera from marker."""
        self._placed = np.full((len(seen.numbers), 4, 4), np.nan)
        self._options: list[Transforms] = [np.zeros((0, 4, 4))] * len(seen.views)
        """Poses that each view may have, camera from world: two where it shows one known marker."""

    def grow(self) -> MarkerMap:
        marker: int | None = int(np.bincount(self._seen.marker).argmax())
        self._placed[marker] = np.eye(4)
        while marker is not None:
            for view in np.unique(self._seen.view[self._seen.marker == marker]).tolist():
                self._look_again(view)
            marker = self._place_next()
        poses = np.full((len(self._options), 4, 4), np.nan)
        for view, options in enumerate(self._options):
            if len(options) > 1:
                (sighting,) = self._known(view)
                first, second = self._misses(options @ self._placed[self._seen.marker[sighting]], sighting)
                if second <= _CLEAR * first:
                    continue
            if len(options):
                poses[view] = options[0]
        return MarkerMap(poses, self._placed, np.ones(len(self._placed)), self._lenses)

    def _known(self, view: int) -> list[int]:
        """Sightings of the view of markers that are placed."""
        those = np.flatnonzero(self._seen.view == view).tolist()
        return [s for s in those if np.isfinite(self._placed[self._seen.marker[s], 0, 0])]

    def _misses(self, camera_from_marker: Transforms, sighting: int) -> Float64[np.ndarray, "*n"]:
        """Mean pixels by which the corners of a sighting are missed."""
        local = transformed(camera_from_marker, SQUARE)
        depth = np.where(local[..., 2:] > 1e-6, local[..., 2:], np.nan)
        away = np.linalg.norm(local[..., :2] / depth - self._ideal[sighting], axis=-1).mean(axis=-1)
        return np.minimum(np.nan_to_num(away * self._focal[sighting], nan=_WORST_PX), _WORST_PX)

    def _look_again(self, view: int) -> None:
        """The pose of a view that is best for all markers that are placed, or both of a single one."""
        known = [(s, self._placed[self._seen.marker[s]]) for s in self._known(view)]
        options = np.concatenate([self._squares[s] @ np.linalg.inv(pose) for s, pose in known])
        if len(known) > 1:
            misses = np.sum([self._misses(options @ pose, s) for s, pose in known], axis=0)
            corners = np.concatenate([transformed(pose, SQUARE) for _, pose in known])
            ideal = np.concatenate([self._ideal[s] for s, _ in known])
            first, cv2 = options[int(np.argmin(misses))], require_opencv()
            turn, shift = cv2.Rodrigues(first[:3, :3])[0], first[:3, 3:].copy()
            refined = cv2.solvePnPRefineLM(corners, ideal[:, None].copy(), np.eye(3), None, turn, shift)
            options = _transform(*refined)[None]
        self._options[view] = options

    def _place_next(self) -> int | None:
        """Place the marker that most views with a pose see; None where there is none."""
        support: dict[int, list[int]] = {}
        for sighting, (view, marker) in enumerate(zip(self._seen.view, self._seen.marker, strict=True)):
            if len(self._options[view]) and np.isnan(self._placed[marker, 0, 0]):
                support.setdefault(int(marker), []).append(sighting)
        if not support:
            return None
        marker = max(support, key=lambda one: len(support[one]))
        options = {s: self._options[self._seen.view[s]] for s in support[marker]}
        candidates = np.concatenate(
            [
                (np.linalg.inv(poses)[:, None] @ self._squares[s]).reshape(-1, 4, 4)
                for s, poses in options.items()
            ]
        )
        misses = [self._misses(poses[:, None] @ candidates, s).min(axis=0) for s, poses in options.items()]
        self._placed[marker] = candidates[int(np.sum(misses, axis=0).argmin())]
        return marker


def _square_poses(ideal: Float64[np.ndarray, "4 2"]) -> Float64[np.ndarray, "2 4 4"]:
    """Both poses of a square of side 1, the better first."""
    cv2 = require_opencv()
    flat = cv2.SOLVEPNP_IPPE_SQUARE
    _, turns, shifts, _ = cv2.solvePnPGeneric(SQUARE, ideal[:, None], np.eye(3), None, flags=flat)
    poses = [_transform(turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
    return np.stack([*poses, np.eye(4), np.eye(4)][:2])


def _transform(turn: np.ndarray, shift: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = require_opencv().Rodrigues(turn)[0], np.ravel(shift)
    return pose


# Bundle adjustment, sightings that don't fit, and distortion.


def _adjust(
    found: MarkerMap, seen: Seen, free: Bool[np.ndarray, " L"], same_size: bool = False, steps: int = 60
) -> tuple[MarkerMap, Bool[np.ndarray, " S"]]:
    """The map that explains most sightings, and which these are."""
    usable = np.isfinite(found.misses(seen))
    found = solve(found, seen.part(usable), free, same_size, loss="soft_l1", steps=steps)
    misses = found.misses(seen)
    kept = misses < max(_OUTLIER_PX, _OUTLIER_FACTOR * float(np.median(misses[usable])))
    return solve(found, seen.part(kept), free, same_size, steps=steps), kept


def _refuse_several_sizes(found: MarkerMap, seen: Seen, kept: Bool[np.ndarray, " S"]) -> None:
    markers = np.flatnonzero(np.bincount(seen.marker[kept], minlength=len(seen.numbers)) > 1)
    relative = found.sizes[markers] / np.median(found.sizes[markers])
    odd = np.abs(relative - 1.0) > _SIZE_TOLERANCE
    if odd.any():
        each = [f"{seen.numbers[markers[i]]} ({relative[i]:.2f})" for i in np.flatnonzero(odd)]
        raise CaptureError(
            f"markers have several sizes: over the usual one, {name_some(each)}; expected the side that --marker-size "
            "gives: cover the others, or print them in another --marker-family"
        )


def _refuse_moved(found: MarkerMap, seen: Seen, kept: Bool[np.ndarray, " S"]) -> None:
    misses = found.misses(seen)
    usable = np.isfinite(misses)
    lost = usable & ~kept
    diagonal = max(float(np.hypot(lens.width, lens.height)) for lens in found.lenses)
    typical, limit = float(np.median(misses[usable])), max(_MOST_OFF_PX, _MOST_OFF * diagonal)
    if typical <= limit and lost.sum() <= _MOST_LEFT_OUT * usable.sum():
        return
    found_is = f"corners are off by {typical:.2g} px in the median (at most {limit:.2g} is expected)"
    if typical <= limit:
        lost_of, seen_of = (
            np.bincount(seen.marker[those], minlength=len(seen.numbers)) for those in (lost, usable)
        )
        share = lost_of / np.maximum(seen_of, 1)
        numbers = [str(seen.numbers[index]) for index in np.argsort(-share) if share[index] > _MOST_LEFT_OUT]
        found_is = (
            f"{lost.sum() / usable.sum():.0%} of the sightings are off, by {np.median(misses[lost]):.3g} px in the "
            f"median, most of them of the markers {name_some(numbers)}"
        )
    raise CaptureError(
        f"markers did not keep their places: {found_is}; expected boards that are fixed to the object: cover those "
        "that are not. If none moved, the lens is distorted by more than k1 and k2 describe"
    )


def _pose_set(
    found: MarkerMap,
    seen: Seen,
    kept: Bool[np.ndarray, " S"],
    sightings: Sightings,
    marker_size: float | None,
    free: Bool[np.ndarray, " L"],
) -> PoseSet:
    """Cameras in the world that stands on the markers, those without enough markers named."""
    views, markers = np.unique(seen.view[kept]), np.unique(seen.marker[kept])
    corners = transformed(found.world_from_marker[markers], np.broadcast_to(SQUARE, (len(markers), 4, 3)))
    to_board, up, how_up = _stand_on_markers(corners, marker_size or 1.0)
    cameras = {}
    for view in views:
        pose, lens = np.linalg.inv(found.camera_from_world[view]), found.lenses[seen.sensor[view]]
        camera = PosedCamera(np.column_stack([pose[:3, :3] @ FLIP, pose[:3, 3]]), lens)
        cameras[seen.views[view]] = camera.moved(to_board)
    error = float(np.sqrt(np.mean(found.misses(seen)[kept] ** 2)))
    found_in = f"{counted(len(markers), 'marker')} in {len(seen.view[kept])} sightings"
    gave = f"markers gave poses of {len(cameras)} of {len(sightings)} views: {found_in}"
    notes = [f"{gave}, corners off by {error:.2f} px (root mean square)"]
    if missing := [name for name in sightings if name not in cameras]:
        notes.append(f"views without enough markers: {name_some(missing)}")
    if unused := int((~kept).sum()):
        notes.append(f"{counted(unused, 'sighting')} of markers left out as not fitting the others")
    focal = [f"{lens.focal_px[0]:.1f}" for lens, is_free in zip(found.lenses, free, strict=True) if is_free]
    notes += [f"focal length estimated from the markers: {', '.join(focal)} px"] if focal else []
    notes += [how_up, _how_large(marker_size)]
    return PoseSet(
        dict(sorted(cameras.items())),
        "markers in the pictures",
        to_board.to_scene(corners.reshape(-1, 3)),
        up=up,
        has_world=marker_size is not None,
        metres_per_unit=None if marker_size is None else 1.0,
        markers={
            str(seen.numbers[marker]): to_board.to_scene(square)
            for marker, square in zip(markers, corners, strict=True)
        },
        notes=tuple(notes),
    )


def _how_large(marker_size: float | None) -> str:
    if marker_size is None:
        return "there is no scale: give --marker-size or --known-distance for exports in metres"
    return f"the scale is that of markers with sides of {marker_size:g} m"


def _stand_on_markers(
    corners: Float64[np.ndarray, "M 4 3"], marker_size: float
) -> tuple[Placement, Float64[np.ndarray, "3"] | None, str]:
    """The way to the world that stands on the markers, in which their sides have a length; up in that world, None where
    no two markers lie in a plane; and how up was found."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    normals = np.cross(corners[:, 1] - corners[:, 2], corners[:, 0] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    alike = normals @ normals.T > _ONE_PLANE
    group = alike[int(alike.sum(axis=1).argmax())]
    points = corners[group].reshape(-1, 3)
    up = normals[group].mean(axis=0)
    flat = np.linalg.svd(points - points.mean(axis=0))[2][2]
    flat *= np.sign(flat @ up)
    up = flat if flat @ up > _ONE_PLANE * np.linalg.norm(up) else up / np.linalg.norm(up)
    across = corners[group][0, 1] - corners[group][0, 0]
    x = across - (across @ up) * up
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up])
    to_board = Placement(rotation, -rotation @ points.mean(axis=0), marker_size / float(np.median(sides)))
    if group.sum() < 2 <= len(corners):
        return to_board, None, "no two markers lie in one plane, so they do not tell up"
    how_up = f"up is square to the plane of {counted(int(group.sum()), 'marker')}"
    return to_board, np.array([0.0, 0.0, 1.0]), how_up


def metric_poses(poses: PoseSet, sightings: Sightings, marker_size: float) -> PoseSet:
    """Poses that were found without markers, in the world that stands on the markers in view. Raises CaptureError: no
    marker is seen by two cameras that agree on where it is."""
    views_of: dict[int, list[tuple[PosedCamera, np.ndarray]]] = {}
    for name, markers in sightings.items():
        camera = poses.cameras.get(name)
        if camera is not None and camera.lens is not None:
            for number, pixels in markers.items():
                views_of.setdefault(number, []).append((camera, pixels))
    located = {str(number): _located(those) for number, those in views_of.items() if len(those) > 1}
    corners = {name: found for name, found in located.items() if found is not None}
    if not corners:
        raise CaptureError(
            f"--marker-size: {counted(len(views_of), 'marker')} in the views, none of them seen by two cameras that "
            "agree; take the same one, sharp, into more pictures, or leave --marker-size out"
        )
    way, up, how_up = _stand_on_markers(np.stack(list(corners.values())), marker_size)
    notes = (*poses.notes, how_up, _how_large(marker_size))
    marked = replace(poses, markers=corners).moved(way)
    return replace(marked, up=up, has_world=True, metres_per_unit=1.0, notes=notes)


def _located(
    seen: Sequence[tuple[PosedCamera, Float64[np.ndarray, "4 2"]]],
) -> Float64[np.ndarray, "4 3"] | None:
    """Corners where rays of cameras meet, None where they don't; cameras that disagree are left out."""
    agreeing = list(seen)
    while len(agreeing) > 1 and (meeting := where_rays_meet(agreeing)) is not None:
        points, away = meeting
        misses = np.sqrt((away**2).mean(axis=1))
        if np.max(misses) < 2.0 * _OUTLIER_PX:
            return points
        agreeing.pop(int(np.argmax(np.nan_to_num(misses, nan=np.inf))))
    return None
