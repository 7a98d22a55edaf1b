"""The cameras of a capture's views: found, given to views by name and by rig, and placed in the scene's world.

The lenses of a rig get poses from each other: where two have poses in the same releases of the shutter, their offset
follows from these. Otherwise the rotations that the files give are used, and the lenses are taken to be in one place
(`RigRelatives`: Euler angles in degrees, R = Rx Ry Rz, from the axes of the lens to those of the reference lens, with
+x right, +y down, +z forward).

The scene's world has +z up, its middle in the origin, its cameras at most 1 away; how it came about is recorded.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.camera_tags import tag_numbers
from unmix_plugin.captures.known_distance import KnownDistance, metres_per_unit
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import FLIP, PosedCamera, PoseSet, match_poses
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.captures.spectral_file import Capture, CaptureView
from unmix_plugin.engine.geometry.camera_paths import focus_point, meeting_point
from unmix_plugin.errors import CaptureError, ConfigError, counted, name_some
from unmix_plugin.scenes.placement import METRES_KEY, Placement

FROM_PICTURES = ESTIMATE, MARKERS, TURNTABLE = "estimate", "markers", "turntable"
"""Words that ask to find poses instead of reading them."""
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

_Pose: TypeAlias = Float64[np.ndarray, "4 4"]
_Offsets: TypeAlias = dict[tuple[str, str], _Pose]
"""From the camera space of the second lens to that of the first, by the names of both, OpenGL axes."""


@dataclass(frozen=True)
class PosedViews:
    """Views with their cameras, in the scene's world."""

    views: tuple[CaptureView, ...]
    poses: PoseSet
    """In the scene's world: cameras by view, each with the lens of the whole image in its file; the sparse points."""
    findings: tuple[str, ...]
    """What looks wrong, one sentence each."""
    keys: dict[str, Any]
    """What transforms.json records of the way from the source's world to the scene's, and of metres. Where the poses
    were estimated, exports return to the scene's world, which stands upright: there is no way, or only a scale."""
    notes: tuple[str, ...]


def given_poses(capture: Capture, where: str | None) -> PoseSet:
    """The poses of a file, in the working directory or the capture's folder, or those of the layout. Raises
    CaptureError: there are none, or they can't be read."""
    if where is None:
        if capture.poses is None:
            why = "".join(f" ({note})" for note in capture.notes if "poses" in note)
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
    """Give each view its camera, lenses of a rig that of others of their release; views without one are left out.
    Poses that don't tell metres get them from a distance that is known. Raises CaptureError: fewer than two views have
    a camera, or a lens does not fit its view. Raises ConfigError: the distance does not go with the poses."""
    files = [
        (view.name, [*view.cube.files, *([] if view.picture is None else [view.picture])]) for view in views
    ]
    cameras, said = match_poses(poses, files)
    cameras, completed = _complete_rigs(views, cameras)
    matched = [note for note in said if not (completed and "without pose" in note)]
    posed = tuple(view for view in views if view.name in cameras)
    if len(posed) < _LEAST_VIEWS:
        raise CaptureError(
            f"{poses.source}: {len(posed)} of {len(views)} views has a pose; a scene needs {_LEAST_VIEWS} or more. "
            + "; ".join(said)
        )
    fitted = {
        view.name: replace(cameras[view.name], lens=lens_of_view(cameras[view.name].lens or view.lens, view))
        for view in posed
    }
    has_many_lenses = len({view.sensor for view in posed if view.release}) > 1
    own = {view.sensor: view.lens for view in posed if cameras[view.name].lens in (None, view.lens)}
    resampled = [
        f"lens {sensor}: {lens.resampled_from.said}"
        for sensor, lens in own.items()
        if lens and lens.resampled_from
    ]
    placed, way, how = _place_poses(replace(poses, cameras=fitted), is_flight=has_many_lenses)
    keys = way.to_json() if poses.has_world else {}
    if poses.has_world and poses.metres_per_unit is not None:
        keys[METRES_KEY] = poses.metres_per_unit
    if known is not None:
        if poses.metres_per_unit is not None:
            raise ConfigError(f"--known-distance: {poses.source} gives metres already; leave it out")
        metres, said = metres_per_unit(known, fitted if poses.has_world else placed.cameras)
        if poses.has_world:
            keys[METRES_KEY] = metres
        else:  # exports return to the scene's upright world, in metres
            keys = Placement(scale=1.0 / metres).to_json() | {METRES_KEY: 1.0}
        how = (*how, said)
    notes = (*poses.notes, *matched, *completed, *resampled, *how)
    findings = [*_unposed(views, posed, poses.source), *_other_sizes(posed, cameras)]
    return PosedViews(posed, placed, tuple(findings), keys, notes)


def _unposed(views: Sequence[CaptureView], posed: Sequence[CaptureView], source: str) -> list[str]:
    """Whether so many views lack a pose that the source itself is suspect."""
    missing = [view.name for view in views if view not in posed]
    if len(missing) <= _MOST_UNPOSED * len(views):
        return []
    left_out = f"{len(missing)} of {len(views)} views have no pose and are left out ({name_some(missing)})"
    return [f"{left_out}: is {source} the whole model, and are the names in it those of the files?"]


def _other_sizes(posed: Sequence[CaptureView], cameras: Mapping[str, PosedCamera]) -> list[str]:
    """Lenses given for pictures of another size, which is no whole multiple: cut, perhaps, and not scaled."""
    for view in posed:
        lens, (height, width, _) = cameras[view.name].lens or view.lens, view.cube.shape
        if lens is None or (lens.width, lens.height) == (width, height):
            continue
        ratio = max(width / lens.width, lens.width / width)
        if abs(ratio - round(ratio)) > _MOST_STRETCH * ratio:
            finding = (
                f"the lens of view {view.name} is given for {lens.width} x {lens.height} pixels, its file has {width} "
                f"x {height}: taken as scaled. If it was cut instead, give the lens of the cut picture"
            )
            return [finding]
    return []


def lens_of_view(lens: Lens | None, view: CaptureView) -> Lens:
    """The lens in pixels of the view's file, of which it may be given at another resolution. Raises CaptureError: there
    is none, or it is that of pictures of another shape."""
    height, width, _ = view.cube.shape
    if lens is None:
        raise CaptureError(f"view {view.name} has a pose but no lens; expected a focal length ('fl_x')")
    if (lens.width, lens.height) == (width, height):
        return lens
    across, down = width / lens.width, height / lens.height
    if abs(across / down - 1.0) > _MOST_STRETCH:
        turned = ", or store them turned as EXIF's orientation says"
        raise CaptureError(
            f"view {view.name} has {width} x {height} pixels (width x height), its lens is given for {lens.width} x "
            f"{lens.height}; expected the same shape: give the poses of these images"
            f"{turned if 'orientation' in view.cube.metadata else ''}"
        )
    return lens.seen_as(width, height, (0.0, 0.0), (across, down))


def _complete_rigs(
    views: Sequence[CaptureView], cameras: Mapping[str, PosedCamera]
) -> tuple[dict[str, PosedCamera], tuple[str, ...]]:
    """Cameras by view, also of views that get the pose of another lens of their release, moved by the rig; and what
    was done, one sentence a lens."""
    releases: dict[str, list[CaptureView]] = defaultdict(list)
    for view in views:
        if view.release:
            releases[view.release].append(view)
    offsets = _measured_offsets(releases, cameras)
    found = {view.sensor: cameras[view.name].lens for view in views if view.name in cameras}
    completed, how = dict(cameras), Counter[tuple[str, str]]()
    for members in releases.values():
        posed = [view for view in members if view.name in cameras]
        for view in members:
            if view.name in cameras:
                continue
            base, offset = _offset_to(view, posed, offsets)
            if base is None or offset is None:
                kind = "unknown" if posed else "unposed"
            else:
                pose = _square(cameras[base.name].camera_to_world) @ offset
                completed[view.name] = PosedCamera(pose[:3], found.get(view.sensor) or view.lens)
                kind = "poses" if (base.sensor, view.sensor) in offsets else "files"
            how[view.sensor, kind] += 1
    said = {
        "unposed": "left out: no lens of their release has a pose",
        "unknown": "left out: there is no pose, and nothing says where the lens is on the rig",
        "poses": "got the pose of another lens of their release, moved as in other releases",
        "files": "got the pose of another lens of their release, turned as the files say, at the same place",
    }
    notes = [f"{counted(n, 'view')} of lens {sensor} {said[kind]}" for (sensor, kind), n in how.items()]
    return completed, tuple(notes)


def _measured_offsets(
    releases: Mapping[str, Sequence[CaptureView]], cameras: Mapping[str, PosedCamera]
) -> _Offsets:
    """Offsets between lenses with poses in one release: mean rotation, median place."""
    found: dict[tuple[str, str], list[_Pose]] = defaultdict(list)
    for members in releases.values():
        posed = [view for view in members if view.name in cameras]
        poses = {view.sensor: _square(cameras[view.name].camera_to_world) for view in posed}
        for first, base in poses.items():
            for second, other in poses.items():
                if first != second:
                    found[first, second].append(np.linalg.inv(base) @ other)
    offsets = {}
    for pair, those in found.items():
        stacked, mean = np.stack(those), np.eye(4)
        left, _, right = np.linalg.svd(stacked[:, :3, :3].mean(axis=0))
        mean[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        mean[:3, 3] = np.median(stacked[:, :3, 3], axis=0)
        offsets[pair] = mean
    return offsets


def _offset_to(
    view: CaptureView, posed: Sequence[CaptureView], offsets: _Offsets
) -> tuple[CaptureView | None, _Pose | None]:
    """A posed view of the release and the offset from it, measured ones first."""
    for base in posed:
        if (base.sensor, view.sensor) in offsets:
            return base, offsets[base.sensor, view.sensor]
    rotation = _rig_rotation(view)
    for base in posed:
        other = _rig_rotation(base)
        if rotation is not None and other is not None:
            offset = np.eye(4)
            offset[:3, :3] = FLIP @ other.T @ rotation @ FLIP
            return base, offset
    return None, None


def _rig_rotation(view: CaptureView) -> Float64[np.ndarray, "3 3"] | None:
    """From the axes of the lens to those of the reference lens, as the file says; None where it doesn't."""
    from scipy.spatial.transform import Rotation

    angles = tag_numbers(view.cube.metadata.get("xmp") or {}, "RigRelatives")
    if angles is None or len(angles) != 3 or not np.isfinite(angles).all():
        return None
    return Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()


def _square(pose: Float64[np.ndarray, "3 4"]) -> _Pose:
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])


def _place_poses(poses: PoseSet, is_flight: bool = False) -> tuple[PoseSet, Placement, tuple[str, ...]]:
    """Poses in the scene's world, the way there from the source's, and how up axis, middle and scale were found.

    The up axis is the source's where it has one, otherwise the direction across which the cameras' horizontal axes lie,
    or the mean of their up vectors. The middle is where the cameras look, or that of the sparse points. In a flight,
    cameras that all look one way look down.
    """
    stacked = np.stack([camera.camera_to_world for camera in poses.cameras.values()])
    up, how_up = _find_up(stacked, poses.up, is_flight)
    middle, how_middle = _find_middle(stacked, poses.points)
    reach = float(np.linalg.norm(stacked[:, :, 3] - middle, axis=1).max())
    scale = 1.0 / reach if reach > 0 else 1.0
    rotation = _turn_to_z(up)
    inner = Placement(rotation, -rotation @ middle, scale)
    placed = replace(poses.moved(inner), offset=np.zeros(3), up=np.array([0.0, 0.0, 1.0]))
    how_large = [f"1 unit of the scene is {1.0 / scale:.6g} of the source"] if poses.has_world else []
    return placed, replace(inner, offset=poses.offset), (how_up, how_middle, *how_large)


def _find_up(
    poses: Float64[np.ndarray, "N 3 4"], known: Float64[np.ndarray, "3"] | None, is_flight: bool
) -> tuple[Float64[np.ndarray, "3"], str]:
    if known is not None:
        return known, "up is the source's"
    back = poses[:, :, 2].mean(axis=0)
    if is_flight and np.linalg.norm(back) > np.cos(np.radians(_MOST_SWAY_DEG)):
        return back / np.linalg.norm(back), "up is against where the cameras look, as they would in a flight"
    mean = poses[:, :, 1].mean(axis=0)
    _, singular, vt = np.linalg.svd(poses[:, :, 0], full_matrices=True)
    is_spread = len(singular) > 1 and singular[1] > np.sin(np.radians(_LEAST_TURN_DEG)) * singular[0]
    vertical = vt[2] * (1.0 if vt[2] @ mean >= 0 else -1.0)
    if is_spread and vertical @ mean > 0.5 * np.linalg.norm(mean) > 0.05:
        return vertical, "up is square to the cameras' horizontal axes"
    if np.linalg.norm(mean) > 0.1:
        return mean / np.linalg.norm(mean), "up is the mean of the cameras' up vectors"
    return np.array([0.0, 0.0, 1.0]), "up is not to be told from the cameras: +z of the source is taken"


def _find_middle(
    poses: Float64[np.ndarray, "N 3 4"], points: Float64[np.ndarray, "P 3"] | None
) -> tuple[Float64[np.ndarray, "3"], str]:
    met, nearest = meeting_point(poses), focus_point(poses)
    if met is None and points is not None and len(points) > 0:
        how = "the middle is that of the sparse points, as the cameras look at no one place"
        return np.median(points, axis=0), how
    if nearest is not None:
        return nearest, "the middle is the point nearest to all optical axes"
    return poses[:, :, 3].mean(axis=0), "the middle is that of the cameras"


def _turn_to_z(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation that takes a unit vector to +z."""
    axis, cosine = np.cross(up, (0.0, 0.0, 1.0)), float(up[2])
    if cosine < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)
