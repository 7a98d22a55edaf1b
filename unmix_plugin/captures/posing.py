"""The cameras of a capture's views: found, given to views by name and by rig, and placed in the scene's world.

The lenses of a rig get poses from each other: where two have poses in the same shots of the shutter, their offset
follows from these. Otherwise the rotations that the files give are used, and the lenses are taken to be in one place
(`RigRelatives`: Euler angles in degrees, R = Rx Ry Rz, from the axes of the lens to those of the reference lens, with
+x right, +y down, +z forward).

Lengths are known where the source's are metres, or by two points that are a known distance apart, each shown in two
views.

The scene's world has +z up, its middle in the origin, its cameras at most 1 away; how it came about is recorded.
"""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.camera_tags import tag_numbers
from unmix_plugin.captures.cube import Capture, CaptureView
from unmix_plugin.captures.names import match_poses
from unmix_plugin.captures.options import ESTIMATE, LINES, MARKERS, TURNTABLE, ProcessOptions
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.lines import line_table_poses
from unmix_plugin.captures.poses.pose_set import FLIP, PosedCamera, PoseSet, where_rays_meet
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.report import Code, Kind, Remark, merged, sentences
from unmix_plugin.engine.geometry.camera_paths import focus_point, meeting_point
from unmix_plugin.errors import CaptureError, ConfigError, did_you_mean
from unmix_plugin.scenes.folder import METRES_KEY
from unmix_plugin.scenes.placement import Placement

_LEAST_VIEWS = 2
"""One to train on and one for evaluation."""
_MOST_UNPOSED = 0.25
"""Share of views without a pose from which the source is probably not read as it was meant."""
_MOST_STRETCH = 0.01
"""By which the shapes of a lens's image and of a cube may differ, as a share."""
_LEAST_TURN_DEG = 10.0
"""Horizontal axes of cameras that span less than this do not tell the vertical."""
_MOST_SWAY_DEG = 30.0
"""Between the axes of cameras that look down and their mean, about."""

_FLAG = "--known-distance"
_DISTANCES_M = (1e-6, 1e6)
_LEAST_MEETING_DEG = 2.0
"""Between the two rays of a point; narrower ones meet at a depth that a pixel decides."""
_MOST_MISS_PX, _MOST_MISS = 3.0, 0.005
"""By which a point may miss a pixel, or over the diagonal of the view: what is greater."""
_LEAST_APART_PX = 5.0

_Seen: TypeAlias = dict[str, tuple[float, float]]
"""Where views show a point, by their names: x and y in the file, the first pixel's centre at 0.5."""
KnownDistance: TypeAlias = tuple[_Seen, _Seen, float]
"""Two points, each in two views, and the metres between them."""
_Pose: TypeAlias = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class PosedViews:
    """Views with their cameras, in the scene's world."""

    views: tuple[CaptureView, ...]
    poses: PoseSet
    """In the scene's world: cameras by view, each with the lens of the whole image in its file; the sparse points."""
    keys: dict[str, Any]
    """What transforms.json records of the way from the source's world to the scene's, and of metres. Where the poses
    were estimated, exports return to the scene's world, which stands upright: there is no way, or only a scale."""
    remarks: tuple[Remark, ...]
    """Whose poses are whose, and where the scene lies."""


def given_poses(capture: Capture, options: ProcessOptions) -> PoseSet:
    """The poses of a file, in the working directory or the capture's folder, or those of the layout. Raises
    CaptureError: there are none, or they can't be read."""
    where = options.poses
    if capture.layout == LINES:
        return line_table_poses(capture.views, capture.root, options)
    if where is None:
        if capture.poses is None:
            why = f" ({capture.no_poses})" if capture.no_poses else ""
            raise CaptureError(
                f"{capture.root}: the layout '{capture.layout}' has no poses{why}; give --poses with transforms.json, "
                f"a COLMAP model or another file, or find them: '--poses {ESTIMATE}', '{MARKERS}' or '{TURNTABLE}'"
            )
        return capture.poses
    path = Path(where)
    if not path.exists() and (capture.root / where).exists():
        path = capture.root / where
    return read_poses(path, {view.name: (view.cube.shape[1], view.cube.shape[0]) for view in capture.views})


def pose_views(
    views: Sequence[CaptureView], poses: PoseSet, known: KnownDistance | None = None
) -> PosedViews:
    """Give each view its camera, lenses of a rig that of others of their shot; views without one are left out.
    Poses that don't tell metres get them from a distance that is known. Raises CaptureError: fewer than two views have
    a camera, or a lens does not fit its view. Raises ConfigError: the distance does not go with the poses."""
    files = [(view.name, [*view.cube.files, *filter(None, [view.picture])]) for view in views]
    cameras, matched = match_poses(poses, files)
    cameras, completed = complete_rigs(views, cameras)
    posed = tuple(view for view in views if view.name in cameras)
    if len(posed) < _LEAST_VIEWS:
        raise CaptureError(
            f"{poses.source}: {len(posed)} of {len(views)} views has a pose; a scene needs {_LEAST_VIEWS} or more. "
            + "; ".join(sentences(matched, Kind.DONE))
        )
    given = {view.name: cameras[view.name].lens or view.lens for view in posed}
    fitted = {
        view.name: replace(cameras[view.name], lens=lens_of_view(given[view.name], view)) for view in posed
    }
    has_many_lenses = len({view.sensor for view in posed if view.shot}) > 1
    of_files = {view.sensor: view.lens for view in posed if view.lens and view.lens == given[view.name]}
    lenses = [
        Remark.of(Code.LENS_OF_SENSOR, lens=name, text=lens.note)
        for name, lens in of_files.items()
        if lens.note
    ]
    placed, to_scene, how = place_poses(replace(poses, cameras=fitted), is_flight=has_many_lenses)
    metres, keys = poses.metres_per_unit, to_scene.to_json() if poses.has_world else {}
    if known is not None:
        if metres is not None:
            raise ConfigError(f"--known-distance: {poses.source} gives metres already; leave it out")
        metres, scaled_by = _metres_per_unit(known, fitted if poses.has_world else placed.cameras)
        how.append(scaled_by)
        if not poses.has_world:  # exports return to the scene's upright world, in metres
            keys, metres = Placement(scale=1.0 / metres).to_json(), 1.0
    if metres is not None and keys:
        keys[METRES_KEY] = metres
    remarks = [Remark.of(Code.NOTE, text=text) for text in poses.notes]
    missing = [view.name for view in views if view not in posed]
    if len(missing) > _MOST_UNPOSED * len(views):  # so many that the source itself is suspect
        facts = {"unposed": len(missing), "views": len(views), "names": missing, "source": poses.source}
        remarks.append(Remark.of(Code.MANY_VIEWS_UNPOSED, **facts))
    if completed:  # which says of each lens what became of views without a pose
        matched = [remark for remark in matched if remark.code is not Code.VIEWS_UNPOSED]
    remarks += [*matched, *completed, *lenses, *_other_sizes(posed, given), *how]
    return PosedViews(posed, placed, keys, tuple(remarks))


def _other_sizes(posed: Sequence[CaptureView], lenses: Mapping[str, Lens | None]) -> list[Remark]:
    """Lenses given for pictures of another size: the first that is no whole multiple, so that it was cut, perhaps, and
    not scaled; and the others."""
    cut, scaled = [], []
    for view in posed:
        lens, (height, width, _) = lenses[view.name], view.cube.shape
        if lens is None or lens.width == width:
            continue
        ratio = max(width / lens.width, lens.width / width)
        facts = {"given": f"{lens.width} x {lens.height} pixels", "size": f"{width} x {height}"}
        if abs(ratio - round(ratio)) <= _MOST_STRETCH * ratio:
            scaled.append(Remark.of(Code.LENS_SCALED, **facts))
        elif not cut:
            cut.append(Remark.of(Code.LENS_PERHAPS_CUT, view=view.name, **facts))
    return [*cut, *merged(scaled)]


def lens_of_view(lens: Lens | None, view: CaptureView) -> Lens:
    """The lens in pixels of the view's file, of which it may be given at another resolution. Raises CaptureError: there
    is none, or it is that of pictures of another shape."""
    height, width, _ = view.cube.shape
    if lens is None:
        raise CaptureError(f"view {view.name} has a pose but no lens; expected a focal length ('fl_x')")
    if (lens.width, lens.height) == (width, height):
        return lens
    if (lens.width, lens.height) == (width, height + view.cube.dark_lines):  # given for all lines of the file
        return lens.seen_as(width, height, (0.0, 0.0), (1.0, 1.0))
    across, down = width / lens.width, height / lens.height
    if abs(across / down - 1.0) > _MOST_STRETCH:
        turned = ", or store them turned as EXIF's orientation says"
        raise CaptureError(
            f"view {view.name} has {width} x {height} pixels (width x height), its lens is given for {lens.width} x "
            f"{lens.height}; expected the same shape: give the poses of these images"
            f"{turned if view.cube.orientation != 1 else ''}"
        )
    return lens.seen_as(width, height, (0.0, 0.0), (across, down))


def complete_rigs(
    views: Sequence[CaptureView], cameras: Mapping[str, PosedCamera]
) -> tuple[dict[str, PosedCamera], list[Remark]]:
    """Cameras by view, also of views that get the pose of another lens of their shot, moved by the rig; and what
    was done with each lens."""
    from scipy.spatial.transform import Rotation

    shots: dict[str, list[CaptureView]] = defaultdict(list)
    for view in views:
        if view.shot:
            shots[view.shot].append(view)
    # From the camera space of a second lens to that of a first, by the names of both, where both have poses in a shot:
    # mean rotation, median place.
    offsets: dict[tuple[str, str], list[_Pose]] = defaultdict(list)
    for members in shots.values():
        poses = {v.sensor: _square(cameras[v.name].camera_to_world) for v in members if v.name in cameras}
        for first, second in permutations(poses, 2):
            offsets[first, second].append(np.linalg.inv(poses[first]) @ poses[second])
    measured = {}
    for pair, those in offsets.items():
        stacked, measured[pair] = np.stack(those), np.eye(4)
        measured[pair][:3, :3] = Rotation.from_matrix(stacked[:, :3, :3]).mean().as_matrix()
        measured[pair][:3, 3] = np.median(stacked[:, :3, 3], axis=0)
    lenses = {view.sensor: cameras[view.name].lens for view in views if view.name in cameras}
    completed, how = dict(cameras), Counter[tuple[str, Code]]()
    for members in shots.values():
        posed = [view for view in members if view.name in cameras]
        for view in members:
            if view.name in cameras:
                continue
            pairs = [(base, (base.sensor, view.sensor)) for base in posed]
            by_poses = [(base, measured[pair]) for base, pair in pairs if pair in measured]
            stated = [(base, _stated_offset(base, view)) for base in posed]
            by_files = [(base, offset) for base, offset in stated if offset is not None]
            if by_poses or by_files:
                base, offset = (by_poses or by_files)[0]
                pose = _square(cameras[base.name].camera_to_world) @ offset
                completed[view.name] = PosedCamera(pose[:3], lenses.get(view.sensor) or view.lens)
            code = Code.RIG_OFFSET_UNKNOWN if posed else Code.RIG_WITHOUT_POSE
            code = Code.RIG_AS_FILES_SAY if by_files else code
            how[view.sensor, Code.RIG_AS_OTHER_SHOTS if by_poses else code] += 1
    return completed, [Remark.of(code, views=n, lens=sensor) for (sensor, code), n in how.items()]


def _stated_offset(base: CaptureView, view: CaptureView) -> _Pose | None:
    """The same by the rotations of both lenses to the reference lens that their files say; None where one doesn't."""
    from scipy.spatial.transform import Rotation

    angles = [tag_numbers(one.cube.camera.xmp, "RigRelatives") for one in (base, view)]
    if any(three is None or len(three) != 3 or not np.isfinite(three).all() for three in angles):
        return None
    first, second = (Rotation.from_euler("XYZ", three, degrees=True).as_matrix() for three in angles)
    offset = np.eye(4)
    offset[:3, :3] = FLIP @ first.T @ second @ FLIP
    return offset


def _square(pose: Float64[np.ndarray, "3 4"]) -> _Pose:
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])


def place_poses(poses: PoseSet, is_flight: bool = False) -> tuple[PoseSet, Placement, list[Remark]]:
    """Poses in the scene's world, the way there from the source's, and how up axis, middle and scale were found. In a
    flight, cameras that all look one way look down."""
    stacked = np.stack([camera.camera_to_world for camera in poses.cameras.values()])
    up, how_up = _find_up(stacked, poses.up, is_flight)
    middle, how_middle = stacked[:, :, 3].mean(axis=0), Code.MIDDLE_OF_CAMERAS
    nearest, points = focus_point(stacked), poses.points
    if meeting_point(stacked) is None and points is not None and len(points) > 0:
        middle, how_middle = np.median(points, axis=0), Code.MIDDLE_OF_POINTS
    elif nearest is not None:
        middle, how_middle = nearest, Code.MIDDLE_OF_AXES
    places = [camera.lines[:, :, 3] for camera in poses.cameras.values() if camera.lines is not None]
    reach = float(np.linalg.norm(np.concatenate([stacked[:, :, 3], *places]) - middle, axis=1).max())
    scale = 1.0 / reach if reach > 0 else 1.0

    # The smallest rotation that takes up to +z.
    cosine, cross = float(up[2]), np.cross(np.eye(3), np.cross(up, (0.0, 0.0, 1.0)))
    is_upside_down = cosine < -1.0 + 1e-9
    rotation = FLIP if is_upside_down else np.eye(3) + cross + cross @ cross / (1.0 + cosine)

    inner = Placement(rotation, -rotation @ middle, scale)
    placed = replace(poses.moved(inner), offset=np.zeros(3), up=np.array([0.0, 0.0, 1.0]))
    how = [Remark.of(how_up), Remark.of(how_middle)]
    how += [Remark.of(Code.UNIT_OF_SCENE, units=f"{1.0 / scale:.6g}")] if poses.has_world else []
    return placed, replace(inner, offset=poses.offset), how


def _find_up(
    poses: Float64[np.ndarray, "N 3 4"], known: Float64[np.ndarray, "3"] | None, is_flight: bool
) -> tuple[Float64[np.ndarray, "3"], Code]:
    if known is not None:
        return known, Code.UP_OF_SOURCE
    back = poses[:, :, 2].mean(axis=0)
    if is_flight and np.linalg.norm(back) > np.cos(np.radians(_MOST_SWAY_DEG)):
        return back / np.linalg.norm(back), Code.UP_AGAINST_FLIGHT
    mean = poses[:, :, 1].mean(axis=0)
    _, singular, vt = np.linalg.svd(poses[:, :, 0], full_matrices=True)
    is_spread = len(singular) > 1 and singular[1] > np.sin(np.radians(_LEAST_TURN_DEG)) * singular[0]
    vertical = vt[2] * (1.0 if vt[2] @ mean >= 0 else -1.0)
    if is_spread and vertical @ mean > 0.5 * np.linalg.norm(mean) > 0.05:
        return vertical, Code.UP_BY_AXES
    if np.linalg.norm(mean) > 0.1:
        return mean / np.linalg.norm(mean), Code.UP_BY_MEAN
    return np.array([0.0, 0.0, 1.0]), Code.UP_UNKNOWN


# How long a unit of the poses' world is, by two points.


def asked_distance(options: ProcessOptions, views: Sequence[CaptureView]) -> KnownDistance | None:
    """What the user measured, if anything. Raises ConfigError: it is not what it must be, or markers give the scale."""
    if options.known_distance is None:
        return None
    if options.marker_size is not None:
        raise ConfigError(f"{_FLAG} and --marker-size both give the scale; give one of them")
    *texts, metres = options.known_distance
    low, high = _DISTANCES_M
    if not low <= metres <= high:
        raise ConfigError(f"{_FLAG}: the distance is {metres:g}; expected metres, {low:g} to {high:g}")
    sizes = {view.name: (view.cube.shape[1], view.cube.shape[0]) for view in views}
    seen: list[tuple[str, tuple[float, float]]] = []
    for text in texts:
        match = re.fullmatch(r"(.+):\s*(-?\d+(?:\.\d*)?)\s*,\s*(-?\d+(?:\.\d*)?)\s*", text)
        if match is None:
            raise ConfigError(
                f"{_FLAG}: {text!r} is no pixel; expected VIEW:column,row, such as view_03:120,80"
            )
        name, column, row = match[1], float(match[2]), float(match[3])
        if name not in sizes:
            hint = did_you_mean(name, sizes, likeness=0.4, form=" ({})")
            raise ConfigError(f"{_FLAG} {text}: no view {name!r}{hint}; expected such as {next(iter(sizes))}")
        right, bottom = (size - 1 for size in sizes[name])
        if not (0 <= column <= right and 0 <= row <= bottom):
            raise ConfigError(
                f"{_FLAG} {text}: outside the view; expected columns 0 to {right}, rows 0 to {bottom}"
            )
        seen.append((name, (column + 0.5, row + 0.5)))
    first, second = dict(seen[:2]), dict(seen[2:])
    for number, point in enumerate((first, second), 1):
        if len(point) < 2:
            raise ConfigError(f"{_FLAG}: both pixels of point {number} are of one view; expected two views")
    return first, second, metres


def _metres_per_unit(known: KnownDistance, cameras: Mapping[str, PosedCamera]) -> tuple[float, Remark]:
    """Metres in a unit of the world that cameras with lenses stand in, and how sure that is. Raises ConfigError: a
    view has no pose, the pixels of a point are not those of one, or the points are the same."""
    places = []
    for number, point in enumerate(known[:2], 1):  # where the two rays of each point meet
        where, seen, rays = f"{_FLAG}: point {number}, views {' and '.join(point)}", [], []
        limit = _MOST_MISS_PX
        for name, pixel in point.items():
            if name not in cameras:
                raise ConfigError(f"{where}: {name} has no pose; choose another view that shows the point")
            camera = cameras[name]
            pixels = None if camera.lens is None else camera.lens.from_file(np.array([pixel]))
            ray = None if pixels is None else camera.rays_of(pixels)
            if camera.lens is None or pixels is None or ray is None:
                raise ConfigError(f"{where}: the lens of {name} can't be followed there; choose another view")
            seen.append((camera, pixels))
            rays.append(ray[0])
            limit = max(limit, _MOST_MISS * math.hypot(camera.lens.width, camera.lens.height))
        angle = math.degrees(math.asin(min(1.0, float(np.linalg.norm(np.cross(*rays))))))
        if angle < _LEAST_MEETING_DEG:
            raise ConfigError(
                f"{where}: its rays are nearly parallel ({angle:.2f} degrees between them); expected "
                f"{_LEAST_MEETING_DEG:g} or more: choose views that are farther apart"
            )
        meeting = where_rays_meet(seen)
        assert meeting is not None  # both lenses were followed
        miss = float(np.max(meeting[1]))
        if not miss <= limit:
            far = "meet behind a camera" if math.isnan(miss) else f"miss each other by {miss:.1f} px"
            raise ConfigError(
                f"{where}: its rays {far}; expected at most {limit:.1f} px: is it one point, and do the poses fit?"
            )
        places.append(meeting[0][0])
    ends = np.stack(places)
    shown = [cameras[name].pixels_of(ends) for point in known[:2] for name in point]
    apart = float(np.nanmax([np.linalg.norm(pixels[1] - pixels[0]) for pixels in shown]))
    if not apart > _LEAST_APART_PX:
        raise ConfigError(
            f"{_FLAG}: the two points are {apart:.1f} px apart; expected more than {_LEAST_APART_PX:g}: are they the "
            "same?"
        )
    facts = {"metres": f"{known[2]:g}", "pixels": f"{apart:.0f}", "share": f"{1 / apart:.1%}"}
    remark = Remark.of(Code.SCALE_BY_DISTANCE, **facts)
    return known[2] / float(np.linalg.norm(ends[1] - ends[0])), remark
