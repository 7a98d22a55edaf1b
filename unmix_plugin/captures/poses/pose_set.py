"""Cameras by the name of their image, with the sparse points that came with them; and the JSON and XML that they are
read from.

World space is the source's, less an offset, so that float32 has digits enough for geo-referenced cameras. Readers hand
over what is written; `make_pose_set` refuses what is no pose and makes the others rigid.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64, UInt8

from unmix_plugin.captures.poses.lens import Lens, require_possible
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.limits import MOST_TABLE_BYTES, UnreadableJsonError, parse_xml, read_bounded, read_json
from unmix_plugin.scenes.placement import Placement

if TYPE_CHECKING:
    from unmix_plugin.engine.geometry.key_poses import KeyPoses

FLIP = np.diag([1.0, -1.0, -1.0])
"""From OpenGL to OpenCV camera axes and back, from the right."""
_SHEAR_TOLERANCE = 5e-3
"""Largest element of R^T R - 1, after the scale is taken out, that passes as rounding of printed digits."""
_SCALE_TOLERANCE = 1e-3
"""Scales this near to 1 are rounding too, and not mentioned."""
_GREATEST_POSITION = 1e9
"""Positions beyond this are damage."""
_FAR = 100.0
"""Cameras further from the origin than this many times their spread are geo-referenced."""
_FAR_ALONE = 1e4
"""The same for one camera, in units of the source."""

SparsePoints: TypeAlias = tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]
"""Positions and sRGB of structure from motion's points."""


@dataclass(frozen=True)
class PosedCamera:
    """Where an image was taken from."""

    camera_to_world: Float64[np.ndarray, "3 4"]
    """Rotation (orthonormal, determinant 1) and position, OpenGL axes: +x right, +y up, looks along -z; of a line
    camera halfway through its image."""
    lens: Lens | None
    """None where the source gives none."""
    other_names: tuple[str, ...] = ()
    """More files of the same image that the source names, such as its cube."""
    lines: Float64[np.ndarray, "H 3 4"] | None = None
    """Of a line camera the pose of each line, as `camera_to_world`."""

    @property
    def key_poses(self) -> KeyPoses:
        """Poses of lines at their heights in the image, as line cameras have them."""
        import torch  # late: help of commands needs none of it

        from unmix_plugin.engine.geometry.key_poses import KeyPoses

        poses = torch.from_numpy(self.camera_to_world[None] if self.lines is None else self.lines)
        return KeyPoses(poses, torch.arange(len(poses), dtype=poses.dtype) + 0.5, (len(poses),))

    def pixels_of(self, points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 2"]:
        """Where the lens of a frame camera sees points; NaN for points behind the camera."""
        assert self.lens is not None
        assert self.lines is None
        x, y, z = ((points - self.camera_to_world[:, 3]) @ self.camera_to_world[:, :3] @ FLIP).T
        depth = np.where(z > 1e-9, z, np.nan)
        return self.lens.pixels_of(np.column_stack([x / depth, y / depth]))

    def rays_of(self, pixels: Float64[np.ndarray, "P 2"]) -> Float64[np.ndarray, "P 3"] | None:
        """Unit directions into which pixels of a frame camera look; None where the lens folds its picture there."""
        assert self.lens is not None
        assert self.lines is None
        ideal = self.lens.ideal_of(pixels)
        if ideal is None:
            return None
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ FLIP @ self.camera_to_world[:, :3].T
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def moved(self, placement: Placement) -> PosedCamera:
        """The camera in the world that a similarity leads to."""
        lines = None if self.lines is None else placement.moved(self.lines)
        return replace(self, camera_to_world=placement.moved(self.camera_to_world), lines=lines)


@dataclass(frozen=True)
class PoseSet:
    """All cameras of a source."""

    cameras: dict[str, PosedCamera]
    """By the name of the image as the source writes it, with folders and suffix."""
    source: str
    """What the poses come from, for people: `transforms.json`, `COLMAP model in sparse/0`."""
    points: Float64[np.ndarray, "P 3"] | None = None
    """Sparse points of structure from motion."""
    colours: UInt8[np.ndarray, "P 3"] | None = None
    """sRGB of the points."""
    offset: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Add this to positions and points to get the source's coordinates."""
    up: Float64[np.ndarray, "3"] | None = None
    """Unit vector against gravity, where the source's coordinates tell it (geo-referenced, or +z by convention)."""
    has_world: bool = True
    """Whether the coordinates mean something to the user. Those of estimated poses don't."""
    metres_per_unit: float | None = None
    """Metres in a unit of the source, where that is known: printed markers, geo-referenced coordinates."""
    markers: Mapping[str, Float64[np.ndarray, "4 3"]] = field(default_factory=dict)
    """Corners of printed markers by their number, as cameras see them."""
    notes: tuple[str, ...] = ()
    """What was changed or is odd: rotations made rigid, frames without files, ..."""
    warnings: tuple[str, ...] = ()
    """What may make the geometry wrong, one sentence each: reports begin with it."""

    def moved(self, placement: Placement) -> PoseSet:
        """Cameras, points and markers in the world that a similarity leads to."""
        cameras = {name: camera.moved(placement) for name, camera in self.cameras.items()}
        points = None if self.points is None else placement.to_scene(self.points)
        markers = {name: placement.to_scene(corners) for name, corners in self.markers.items()}
        return replace(self, cameras=cameras, points=points, markers=markers)


def angles_between_axes(cameras: Sequence[PosedCamera]) -> Float64[np.ndarray, "N N"]:
    """By how much each camera looks another way than each other one, radians."""
    axes = np.stack([camera.camera_to_world[:, 2] for camera in cameras])
    return np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))


def where_rays_meet(
    seen: Sequence[tuple[PosedCamera, Float64[np.ndarray, "P 2"]]],
) -> tuple[Float64[np.ndarray, "P 3"], Float64[np.ndarray, "N P"]] | None:
    """The points nearest to the rays of cameras through the pixels that show them, and by how many pixels each camera
    misses them, NaN where they are behind it; None where a lens folds its picture."""
    table, wanted = np.zeros((3, 3)), np.zeros(3)
    for camera, pixels in seen:
        rays = camera.rays_of(pixels)
        if rays is None:
            return None
        across = np.eye(3) - rays[:, :, None] * rays[:, None]
        table, wanted = table + across, wanted + across @ camera.camera_to_world[:, 3]
    points = np.linalg.solve(table + 1e-9 * np.eye(3), wanted[..., None])[..., 0]
    misses = [np.linalg.norm(camera.pixels_of(points) - pixels, axis=1) for camera, pixels in seen]
    return points, np.stack(misses)


def make_pose_set(
    cameras: Iterable[tuple[str, PosedCamera]],
    source: str,
    where: str,
    points: SparsePoints | None = None,
    up: Float64[np.ndarray, "3"] | None = None,
    notes: Iterable[str] = (),
    warnings: Iterable[str] = (),
) -> PoseSet:
    """Check and tidy what a reader found: rigid rotations, one camera a name, coordinates near 0.

    Args:
        cameras: With matrices as they are written, which may be scaled, sheared or not finite.
        where: The file, for messages.
        up: Against gravity, in the source's coordinates.
    Raises:
        CaptureError: a name twice with different poses, a matrix that is no pose, or a lens that is none.
    """
    unique: dict[str, PosedCamera] = {}
    repeated: list[str] = []
    for name, camera in cameras:
        first = unique.setdefault(name, camera)
        if first is camera:
            continue
        if not np.array_equal(first.camera_to_world, camera.camera_to_world) or first.lens != camera.lens:
            raise CaptureError(f"{where} has two cameras of the name {name} with different poses; rename one")
        repeated.append(name)
    rigid, scales = _rigid(unique, where)
    offset = find_offset(rigid[:, :, 3])
    rigid[:, :, 3] -= offset
    lenses = dict.fromkeys(camera.lens for camera in unique.values() if camera.lens is not None)
    for lens in lenses:
        require_possible(lens, where)
    all_notes = [*notes, *(lens.note for lens in lenses if lens.note)]
    scaled = scales[np.abs(scales - 1.0) > _SCALE_TOLERANCE]
    if len(scaled):
        low, high = scaled.min(), scaled.max()
        factor = f"{low:.4g}" if high - low <= 1e-3 * high else f"{low:.4g} to {high:.4g}"
        which = f"the rotations of {len(scaled)} of {len(scales)} cameras"
        all_notes.append(f"{which} were scaled by {factor}; made rigid, positions kept")
    if repeated:
        listed = counted(len(repeated), "camera")
        all_notes.append(f"{listed} listed twice with the same pose: {name_some(repeated)}")
    if offset.any():
        all_notes.append(
            f"coordinates are large: less the offset {', '.join(f'{value:.0f}' for value in offset)}"
        )
    positions, colours = points if points is not None and len(points[0]) else (None, None)
    if positions is not None:
        good = (np.abs(positions) <= _GREATEST_POSITION).all(axis=1)  # false for NaN
        if not good.all():
            all_notes.append(
                f"{(~good).sum()} sparse points are not finite, or more than 1e9 units away: left out"
            )
        positions, colours = positions[good] - offset, None if colours is None else colours[good]
    return PoseSet(
        {
            name: replace(camera, camera_to_world=pose)
            for (name, camera), pose in zip(unique.items(), rigid, strict=True)
        },
        source,
        positions,
        colours,
        offset,
        None if up is None else up / np.linalg.norm(up),
        notes=tuple(all_notes),
        warnings=tuple(warnings),
    )


def find_offset(positions: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "3"]:
    """What to subtract so that float32 suffices: the mean, in whole units, if far from 0 against the spread, or 0."""
    middle = positions.mean(axis=0)
    spread = float(np.linalg.norm(positions - middle, axis=1).max())
    distance = float(np.linalg.norm(middle))
    is_far = distance > _FAR * spread if spread > 0 else distance > _FAR_ALONE
    return np.round(middle) if is_far else np.zeros(3)


def _rigid(
    cameras: Mapping[str, PosedCamera], where: str
) -> tuple[Float64[np.ndarray, "N 3 4"], Float64[np.ndarray, " N"]]:
    """The poses with orthonormal rotations of determinant 1, positions kept; and by what the rotations were scaled."""
    if not cameras:
        raise CaptureError(f"{where} has no camera; expected one for each view, export it again")
    faulty: dict[str, list[str]] = {}
    for name, camera in cameras.items():
        if (fault := _fault(camera.camera_to_world)) is not None:
            faulty.setdefault(fault, []).append(name)
    if faulty:
        listed = "; ".join(f"{name_some(names)}: {fault}" for fault, names in faulty.items())
        raise CaptureError(
            f"{where} has {sum(map(len, faulty.values()))} of {len(cameras)} camera matrices that are not poses: "
            f"{listed}; expected camera to world, a rotation (or a scaled one) and a position"
        )
    stacked = np.stack([camera.camera_to_world for camera in cameras.values()])
    u, _, vt = np.linalg.svd(stacked[:, :, :3])
    rigid = np.concatenate([u @ vt, stacked[:, :, 3:]], axis=2)
    if len(rigid) > 1 and (rigid == rigid[0]).all():
        raise CaptureError(f"{where}: all {len(rigid)} cameras have the same pose; estimate them again")
    return rigid, np.cbrt(np.linalg.det(stacked[:, :, :3]))


def _fault(matrix: Float64[np.ndarray, "3 4"]) -> str | None:
    """What is wrong with a matrix; None if it is a similarity."""
    if not np.isfinite(matrix).all():
        return "the matrix has numbers that are not finite"
    if np.abs(matrix).max() > _GREATEST_POSITION:
        return "the camera is more than 1e9 units away, or its rotation scaled by more"
    rotation = matrix[:, :3]
    lengths = np.linalg.norm(rotation, axis=0)
    if lengths.max() < 1e-9:
        return "the rotation is all zeros"
    gram = rotation.T @ rotation / np.mean(lengths**2)
    if np.abs(gram - np.eye(3)).max() > _SHEAR_TOLERANCE:
        axes = ", ".join(f"{length:.4g}" for length in lengths)
        return f"the rotation is sheared (its axes have lengths {axes})"
    if np.linalg.det(rotation) < 0:
        return "the rotation is a mirror image (determinant below 0), so an axis has the wrong sign"
    return None


# JSON and XML of unknown origin.


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context in which an error of the system becomes one of reading a file."""
    try:
        yield
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error


def read_table(path: Path) -> bytes:
    """All of a file; CaptureError where it can't be read, or is too large."""
    with reading(path):
        return read_bounded(path, MOST_TABLE_BYTES)


def load_json(path: Path) -> Any:
    """What a file holds; CaptureError where it can't be read, or is no JSON."""
    try:
        with reading(path):
            return read_json(path)
    except UnreadableJsonError as error:
        raise CaptureError(f"{path} {error}") from error


def load_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file; CaptureError where it can't be read, is no XML, or declares entities."""
    try:
        return parse_xml(read_table(path))
    except ValueError as error:
        raise CaptureError(f"{path} is not valid XML ({error}); was it cut short?") from error


def numbers_in(
    element: ElementTree.Element | None, count: int, where: str
) -> Float64[np.ndarray, " count"] | None:
    """Numbers in the text of an element; None without an element or text, CaptureError for other than `count` finite
    ones."""
    if element is None or not (element.text or "").strip():
        return None
    texts = (element.text or "").split()
    try:
        values = np.array([float(text) for text in texts])
    except ValueError:
        values = np.full(count, np.nan)
    if len(texts) != count or not np.isfinite(values).all():
        found = " ".join(texts)[:60]
        raise CaptureError(f"{where}: <{element.tag}> holds {found!r}; expected {count} finite numbers")
    return values


def number_in(parent: ElementTree.Element, tag: str, where: str, default: float = 0.0) -> float:
    """The number in a child; the default without one."""
    values = numbers_in(parent.find(tag), 1, where)
    return default if values is None else float(values[0])
