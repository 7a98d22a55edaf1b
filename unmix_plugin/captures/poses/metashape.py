"""Poses of Agisoft Metashape: the XML of File > Export > Export Cameras.

A camera's matrix leads from the camera (OpenCV axes) to its component; the component's or the chunk's similarity leads
to the world, often geocentric (metres from the middle of the Earth).

A sensor's lens: u = w / 2 + cx + x' f + x' b1 + y' b2, v = h / 2 + cy + y' f, with x', y' bent by k1..k4 and by p1, p2,
which are OpenCV's p2, p1.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.lens import (
    Lens,
    Points,
    bend_equirectangular,
    bend_fisheye,
    bent_lens,
    fit_lens,
)
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    make_pose_set,
    number_of,
    numbers_of,
)
from unmix_plugin.errors import CaptureError, counted, name_some

_EARTH_RADII = (6.2e6, 6.6e6)
"""Metres from the middle of the Earth between which a position is geocentric."""
_RADIAL = ("k1", "k2", "k3", "k4")


def read_metashape(path: Path, root: ElementTree.Element) -> PoseSet:
    """Poses of all enabled cameras with a transform, in or out of groups. Raises CaptureError: no chunk, no aligned
    camera, several components without a common world, or a lens that can't be represented."""
    chunks = [chunk for chunk in root.iter("chunk") if chunk.get("enabled", "true") != "false"]
    chunks = [chunk for chunk in chunks if chunk.find("cameras") is not None]
    if not chunks:
        raise CaptureError(f"{path} has no chunk with cameras; use File > Export > Export Cameras")
    chunk = max(chunks, key=lambda one: len(list(one.iter("camera"))))
    notes = [f"{len(chunks)} chunks; the one with the most cameras was read"] if len(chunks) > 1 else []
    # Similarities to the world by component; None is the chunk's own, the identity without one.
    owners = [(None, chunk), *((part.get("id"), part) for part in chunk.iterfind("components/component"))]
    worlds: dict[str | None, Float64[np.ndarray, "4 4"]] = {None: np.eye(4)}
    for component, owner in owners:
        if (own := owner.find("transform")) is not None:
            worlds[component] = _similarity(own, path)
    aligned = _of_one_world(_aligned(chunk, path, notes), worlds, notes)
    used = {camera.get("sensor_id") for camera in aligned}
    lenses: dict[str | None, Lens | None] = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        if sensor.get("id") in used:
            lenses[sensor.get("id")], said = _lens_metashape(sensor, str(path))
            notes += said
    raw = []
    for camera in aligned:
        world = worlds.get(camera.get("component_id"), worlds[None])
        values = numbers_of(camera.find("transform"), 16, f"{path}: camera {camera.get('label')}")
        if values is None:
            raise CaptureError(f"{path}: camera {camera.get('label')}: <transform> is empty")
        scale = np.cbrt(np.abs(np.linalg.det(world[:3, :3]))) or 1.0
        matrix = world @ values.reshape(4, 4)
        pose = np.column_stack([matrix[:3, :3] / scale @ FLIP, matrix[:3, 3]])
        name = camera.get("label") or f"camera {camera.get('id')}"
        raw.append((name, PosedCamera(pose, lenses.get(camera.get("sensor_id")))))
    middle = np.mean([camera.camera_to_world[:, 3] for _, camera in raw], axis=0)
    is_geocentric = _EARTH_RADII[0] < np.linalg.norm(middle) < _EARTH_RADII[1]
    notes += ["coordinates are geocentric; up is away from the Earth's middle"] if is_geocentric else []
    has_world = any(np.abs(world - np.eye(4)).max() > 0 for world in worlds.values())
    up = middle if is_geocentric else np.array([0.0, 0.0, 1.0]) if has_world else None
    found = make_pose_set(raw, f"Metashape's {path.name}", str(path), None, up, dict.fromkeys(notes))
    return replace(found, metres_per_unit=1.0 if is_geocentric else None)


def _aligned(chunk: ElementTree.Element, path: Path, notes: list[str]) -> list[ElementTree.Element]:
    cameras = [camera for group in chunk.findall("cameras") for camera in group.iter("camera")]
    enabled = [camera for camera in cameras if camera.get("enabled", "true") != "false"]
    if len(enabled) < len(cameras):
        notes.append(f"{counted(len(cameras) - len(enabled), 'disabled camera')} left out")
    aligned = [camera for camera in enabled if camera.find("transform") is not None]
    missing = [camera.get("label", "?") for camera in enabled if camera.find("transform") is None]
    if not aligned:
        raise CaptureError(
            f"{path}: none of {len(cameras)} cameras is enabled and has a transform; align photos first"
        )
    if missing:
        why = ""
        if any(camera.get("master_id") for camera in enabled if camera.find("transform") is None):
            why = ", some of them lenses of a rig, whose places beside the first lens are not read"
        notes.append(f"{counted(len(missing), 'camera')} without transform{why}: {name_some(missing)}")
    return aligned


def _similarity(element: ElementTree.Element, path: Path) -> Float64[np.ndarray, "4 4"]:
    """rotation, translation and scale of an element, or its 16 numbers."""
    where = str(path)
    if len(element) == 0:
        values = numbers_of(element, 16, where)
        return np.eye(4) if values is None else values.reshape(4, 4)
    rotation, translation = (
        numbers_of(element.find(tag), count, where) for tag, count in (("rotation", 9), ("translation", 3))
    )
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation.reshape(3, 3)
    matrix[:3, :3] *= number_of(element, "scale", where, default=1.0)
    matrix[:3, 3] = 0.0 if translation is None else translation
    return matrix


def _of_one_world(
    cameras: list[ElementTree.Element], worlds: dict[str | None, Float64[np.ndarray, "4 4"]], notes: list[str]
) -> list[ElementTree.Element]:
    """Cameras whose components share a world; without a transform, a component's world is its own."""
    by_component: dict[str | None, list[ElementTree.Element]] = {}
    for camera in cameras:
        by_component.setdefault(camera.get("component_id"), []).append(camera)
    loose = [component for component in by_component if component not in worlds]
    if len(by_component) == 1 or not loose:
        return cameras
    kept = max(by_component.values(), key=len)
    notes.append(
        f"{len(by_component)} components are not aligned to each other: {len(kept)} of {len(cameras)} cameras"
    )
    return kept


def _lens_metashape(sensor: ElementTree.Element, where: str) -> tuple[Lens | None, list[str]]:
    """The lens of a sensor, None without any focal length; and what is not exactly as in the file."""
    name = sensor.get("label", "?")
    where = f"{where}: sensor {name}"
    calibration, size = _calibration_metashape(sensor, where)
    if calibration is None:
        return _from_physical(sensor, size), [f"sensor {name} is not calibrated: nominal focal length"]
    kind = calibration.get("type") or sensor.get("type", "frame")
    if kind not in ("frame", "fisheye", "spherical"):
        raise CaptureError(f"{where} is of the type {kind}; expected frame, fisheye or spherical")
    width, height = size
    if kind == "spherical":
        start = Lens(width, height, (width / (2 * np.pi), height / np.pi), (width / 2, height / 2))
        around, said = bent_lens(bend_equirectangular, (), start, "Metashape spherical", where)
        return around, [f"sensor {name}: {said}"]
    tags = ("f", "cx", "cy", "b1", "b2", "p1", "p2", *_RADIAL)
    values = {tag: number_of(calibration, tag, where) for tag in tags}
    f_x = number_of(calibration, "fx", where, values["f"] + values["b1"])
    f_y = number_of(calibration, "fy", where, values["f"])
    skew = number_of(calibration, "skew", where, values["b2"])
    if min(f_x, f_y) <= 0:
        raise CaptureError(f"{where} has the focal length {min(f_x, f_y):g}; expected pixels above 0")
    center, tangential = (width / 2 + values["cx"], height / 2 + values["cy"]), (values["p2"], values["p1"])
    start, (k1, k2, k3, k4) = Lens(width, height, (f_x, f_y), center), [values[key] for key in _RADIAL]
    frame = replace(start, distortion=(k1, k2, *tangential), higher_radial=(k3, k4))
    if kind == "frame" and not skew:
        return frame, []

    def bent_and_skewed(ideal: Points) -> Points:
        bent = frame.pixels_of(ideal)
        if kind == "fisheye":
            bent = bend_fisheye(ideal, k1, k2, k3, k4, tangential=tangential) * (f_x, f_y) + center
        return bent + np.column_stack([skew * (bent[:, 1] - center[1]) / f_y, np.zeros(len(bent))])

    model = "Metashape fisheye" if kind == "fisheye" else "Metashape with b2"
    fitted, note = fit_lens(bent_and_skewed, start, model, where)
    return fitted, [f"sensor {name}: {note}"]


def _calibration_metashape(
    sensor: ElementTree.Element, where: str
) -> tuple[ElementTree.Element | None, tuple[int, int]]:
    """The adjusted calibration, otherwise the first one, and the size of the picture."""
    found = sorted(sensor.findall("calibration"), key=lambda one: one.get("class") != "adjusted")
    calibration = found[0] if found else None
    for owner in (calibration, sensor):
        resolution = None if owner is None else owner.find("resolution")
        if resolution is None:
            continue
        texts = resolution.get("width", ""), resolution.get("height", "")
        if all(text.isdecimal() and 0 < int(text) < 1_000_000 for text in texts):
            return calibration, (int(texts[0]), int(texts[1]))
    raise CaptureError(f"{where} has no resolution; expected its width and height in pixels")


def _from_physical(sensor: ElementTree.Element, size: tuple[int, int]) -> Lens | None:
    """A pinhole from focal length and pixel size in mm."""
    texts = {element.get("name"): element.get("value", "") for element in sensor.findall("property")}
    try:
        focal, *sides = (float(texts[name]) for name in ("focal_length", "pixel_width", "pixel_height"))
    except (KeyError, ValueError):
        return None
    if not 0 < min(focal, *sides) <= max(focal, *sides) < np.inf:
        return None
    x, y = (focal / side for side in sides)
    return Lens(*size, (x, y), (size[0] / 2, size[1] / 2))
