"""Poses of Agisoft Metashape: the XML of File > Export > Export Cameras.

A camera's matrix leads from the camera (OpenCV axes) to its component; the component's or the chunk's similarity leads
to the world, often geocentric (metres from the middle of the Earth).

A sensor's lens: u = w / 2 + cx + x' f + x' b1 + y' b2, v = h / 2 + cy + y' f, with x', y' distorted by k1..k4 and by
p1, p2, which are OpenCV's p2, p1. PhotoScan up to 1.3 wrote fx and fy in place of f, which is refused by name.

Of a system of several cameras the master alone has a matrix. Another has the master's times what its sensor says once,
[rotation | location]: from its own axes to the master's, and where it stands in these, in the component's units.

Sources: Metashape Professional user manual, camera models; Metashape Python reference, Sensor.rotation and
Sensor.location; agisoft-llc/metashape-scripts 78.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.lens import (
    Lens,
    Points,
    distort_agisoft,
    distort_equirectangular,
    distorted_lens,
    fit_lens,
)
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    make_pose_set,
    number_in,
    numbers_in,
)
from unmix_plugin.errors import CaptureError, counted, name_some

_Element = ElementTree.Element

_EARTH_RADII = (6.2e6, 6.6e6)
"""Metres from the middle of the Earth between which a position is geocentric."""
_RADIAL = ("k1", "k2", "k3", "k4")
_TERMS = ("f", "cx", "cy", "b1", "b2", "p1", "p2", "p3", "p4", *_RADIAL)


def read_metashape(path: Path, root: _Element) -> PoseSet:
    """Poses of all enabled cameras with a transform, in or out of groups. Raises CaptureError: no chunk, no aligned
    camera, several components without a common world, or a lens that can't be represented."""
    chunks = [chunk for chunk in root.iter("chunk") if _is_enabled(chunk)]
    chunks = [chunk for chunk in chunks if chunk.find("cameras") is not None]
    if not chunks:
        raise CaptureError(f"{path} has no chunk with cameras; use File > Export > Export Cameras")
    chunk = max(chunks, key=lambda one: len(list(one.iter("camera"))))
    notes = [f"{len(chunks)} chunks; the one with the most cameras was read"] if len(chunks) > 1 else []
    # Similarities to the world by component; None is the chunk's own, the identity without one.
    worlds: dict[str | None, Float64[np.ndarray, "4 4"]] = {None: np.eye(4)}
    owners = [(None, chunk), *((part.get("id"), part) for part in chunk.iterfind("components/component"))]
    for component, owner in owners:
        if (element := owner.find("transform")) is not None:
            worlds[component] = _similarity(element, str(path))
    aligned = _of_one_world(_aligned(chunk, path, notes), worlds, notes)
    used = {camera.sensor for camera in aligned}
    lenses: dict[str | None, Lens | None] = {}
    warnings = []
    for sensor in chunk.iterfind("sensors/sensor"):
        if sensor.get("id") in used:
            lenses[sensor.get("id")] = _lens_metashape(sensor, str(path), notes)
            if _properties(sensor).get("rolling_shutter", "").strip().lower() in ("true", "1"):
                warnings.append(
                    f"sensor {sensor.get('label', '?')}: 'rolling_shutter' is set and not followed: it stands for rows "
                    "that were read one after the other: each picture gets one pose"
                )
    raw = []
    for camera in aligned:
        world = worlds.get(camera.component, worlds[None])
        scale = np.cbrt(np.abs(np.linalg.det(world[:3, :3]))) or 1.0
        matrix = world @ camera.matrix
        pose = np.column_stack([matrix[:3, :3] / scale @ FLIP, matrix[:3, 3]])
        raw.append((camera.name, PosedCamera(pose, lenses.get(camera.sensor))))
    middle = np.mean([camera.camera_to_world[:, 3] for _, camera in raw], axis=0)
    is_geocentric = _EARTH_RADII[0] < math.hypot(*middle) < _EARTH_RADII[1]
    notes += ["coordinates are geocentric; up is away from the Earth's middle"] if is_geocentric else []
    has_world = any(np.abs(world - np.eye(4)).max() > 0 for world in worlds.values())
    up = middle if is_geocentric else np.array([0.0, 0.0, 1.0]) if has_world else None
    found = make_pose_set(
        raw, f"Metashape's {path.name}", str(path), None, up, dict.fromkeys(notes), dict.fromkeys(warnings)
    )
    return replace(found, metres_per_unit=1.0 if is_geocentric else None)


def _is_enabled(element: _Element) -> bool:
    """Whether the user left a chunk or a camera switched on; up to version 1.5 it is written as 1 or 0."""
    return element.get("enabled", "true").strip().lower() not in ("false", "0")


class _Aligned(NamedTuple):
    """A camera whose place in its component is known."""

    name: str
    sensor: str | None
    component: str | None
    matrix: Float64[np.ndarray, "4 4"]


def _aligned(chunk: _Element, path: Path, notes: list[str]) -> list[_Aligned]:
    """Enabled cameras with a matrix, or with a master that has one and a sensor that says where it stands to it."""
    cameras = [camera for group in chunk.findall("cameras") for camera in group.iter("camera")]
    by_id = {camera.get("id"): camera for camera in cameras}
    enabled = [camera for camera in cameras if _is_enabled(camera)]
    if len(enabled) < len(cameras):
        notes.append(f"{counted(len(cameras) - len(enabled), 'disabled camera')} left out")
    offsets = _offsets(chunk, str(path))
    found, missing, followers = [], [], 0
    for camera in enabled:
        matrix, component = _matrix(camera, path), camera.get("component_id")
        master = by_id.get(camera.get("master_id") or "")  # one that is disabled serves, too
        if matrix is None and master is not None and (of_master := _matrix(master, path)) is not None:
            # The master of a shot may have another sensor than the system's.
            own, others = camera.get("sensor_id"), master.get("sensor_id")
            if own != others and own in offsets and others in offsets:
                matrix = of_master @ np.linalg.inv(offsets[others]) @ offsets[own]
                component = master.get("component_id")
            followers += matrix is not None
        if matrix is None:
            missing.append(camera)
            continue
        name = camera.get("label") or f"camera {camera.get('id')}"
        found.append(_Aligned(name, camera.get("sensor_id"), component, matrix))
    if not found:
        raise CaptureError(
            f"{path}: none of {len(cameras)} cameras is enabled and has a transform; align photos first"
        )
    if followers:
        notes.append(
            f"{counted(followers, 'camera')} placed beside their master by <rotation> and <location>"
        )
    if missing:
        of_rig = any(camera.get("master_id") for camera in missing)
        why = (
            ", some of them in a system of cameras whose master has none either, or whose sensor has no <rotation> and "
            "<location>"
        )
        named = name_some([camera.get("label", "?") for camera in missing])
        notes.append(f"{counted(len(missing), 'camera')} without transform{why * of_rig}: {named}")
    return found


def _matrix(camera: _Element, path: Path) -> Float64[np.ndarray, "4 4"] | None:
    """The matrix of a camera; None where it has none."""
    if (element := camera.find("transform")) is None:
        return None
    values = numbers_in(element, 16, f"{path}: camera {camera.get('label')}")
    if values is None:
        raise CaptureError(f"{path}: camera {camera.get('label')}: <transform> is empty")
    return values.reshape(4, 4)


def _offsets(chunk: _Element, where: str) -> dict[str | None, Float64[np.ndarray, "4 4"]]:
    """Of each sensor the way from its axes to those of the system's master sensor, which has the identity; none of
    those for which none is written."""
    offsets = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        name = f"{where}: sensor {sensor.get('label', '?')}"
        rotation, location = (
            numbers_in(sensor.find("rotation"), 9, name),
            numbers_in(sensor.find("location"), 3, name),
        )
        if rotation is None and location is None and sensor.get("master_id") is not None:
            continue
        offset = np.eye(4)
        offset[:3, :3] = np.eye(3) if rotation is None else rotation.reshape(3, 3)
        offset[:3, 3] = 0.0 if location is None else location
        if not np.allclose(offset[:3, :3] @ offset[:3, :3].T, np.eye(3), atol=1e-3):
            raise CaptureError(f"{name}: <rotation> is no rotation; the file is damaged")
        offsets[sensor.get("id")] = offset
    return offsets


def _similarity(element: _Element, where: str) -> Float64[np.ndarray, "4 4"]:
    """rotation, translation and scale of an element, or its 16 numbers."""
    if len(element) == 0:
        values = numbers_in(element, 16, where)
        return np.eye(4) if values is None else values.reshape(4, 4)
    rotation, translation = (
        numbers_in(element.find(tag), count, where) for tag, count in (("rotation", 9), ("translation", 3))
    )
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation.reshape(3, 3)
    matrix[:3, :3] *= number_in(element, "scale", where, default=1.0)
    matrix[:3, 3] = 0.0 if translation is None else translation
    return matrix


def _of_one_world(
    cameras: list[_Aligned], worlds: dict[str | None, Float64[np.ndarray, "4 4"]], notes: list[str]
) -> list[_Aligned]:
    """Cameras whose components share a world; without a transform, a component's world is its own."""
    by_component: dict[str | None, list[_Aligned]] = {}
    for camera in cameras:
        by_component.setdefault(camera.component, []).append(camera)
    loose = [component for component in by_component if component not in worlds]
    if len(by_component) == 1 or not loose:
        return cameras
    kept = max(by_component.values(), key=len)
    notes.append(
        f"{len(by_component)} components are not aligned to each other: {len(kept)} of {len(cameras)} cameras"
    )
    return kept


def _lens_metashape(sensor: _Element, where: str, notes: list[str]) -> Lens | None:
    """The lens of a sensor, None without any focal length; what is odd is noted."""
    name = sensor.get("label", "?")
    where = f"{where}: sensor {name}"
    calibration, (width, height) = _calibration_metashape(sensor, where)
    kind = (None if calibration is None else calibration.get("type")) or sensor.get("type", "frame")
    if kind not in ("frame", "fisheye", "spherical"):
        raise CaptureError(f"{where} is of the type {kind}; expected frame, fisheye or spherical")
    if kind == "spherical":
        start = Lens(width, height, (width / (2 * np.pi), height / np.pi), (width / 2, height / 2))
        return distorted_lens(
            distort_equirectangular, (), start, f"Metashape spherical of sensor {name}", where
        )
    if calibration is None:
        notes.append(f"sensor {name} is not calibrated: nominal focal length")
        # By focal length and size of a pixel in mm.
        texts, keys = _properties(sensor), ("focal_length", "pixel_width", "pixel_height")
        try:
            focal, *sides = (float(texts[key]) for key in keys)
        except (KeyError, ValueError):
            return None
        if not 0 < min(focal, *sides) <= max(focal, *sides) < np.inf:
            return None
        calibration = ElementTree.Element("calibration")
        across, down = (focal / side for side in sides)
        for tag, value in (("f", down), ("b1", across - down)):
            ElementTree.SubElement(calibration, tag).text = repr(value)
    if calibration.find("f") is None and calibration.find("fx") is not None:
        raise CaptureError(
            f"{where} has <fx> and <fy>, as PhotoScan up to 1.3 wrote them, which is not read; open the project in "
            "Metashape and use File > Export > Export Cameras"
        )
    values = {tag: number_in(calibration, tag, where) for tag in _TERMS}
    f_x, f_y, skew = values["f"] + values["b1"], values["f"], values["b2"]
    if min(f_x, f_y) <= 0:
        raise CaptureError(f"{where} has the focal length {min(f_x, f_y):g}; expected pixels above 0")
    center_x, center_y = width / 2 + values["cx"], height / 2 + values["cy"]
    if not (0 <= center_x <= width and 0 <= center_y <= height):
        raise CaptureError(
            f"{where} has the principal point {center_x:g}, {center_y:g}, outside its {width} x {height} pixels; check "
            "<cx>, <cy> and <resolution> in the file"
        )
    unknown = []
    for child in calibration:
        with suppress(ValueError):
            if child.tag not in _TERMS and float(child.text or ""):
                unknown.append(child.tag)
    if unknown:
        notes.append(f"sensor {name}: numbers that are not known and not used: {name_some(unknown)}")
    tangential = (values["p2"], values["p1"])
    start, growth = Lens(width, height, (f_x, f_y), (center_x, center_y)), (values["p3"], values["p4"])
    k1, k2, k3, k4 = (values[key] for key in _RADIAL)
    frame = replace(start, distortion=(k1, k2, *tangential), higher_radial=(k3, k4))
    more = {"b2": bool(skew), "p3, p4": any(growth) and any(tangential)}
    if kind == "frame" and not any(more.values()):
        return frame

    def distorted_and_skewed(ideal: Points) -> Points:
        distorted = distort_agisoft(ideal, frame.radial, tangential, growth, is_fisheye=kind == "fisheye")
        return distorted @ np.array([[f_x, 0.0], [skew, f_y]]) + start.center_px

    terms = " and ".join(term for term, is_there in more.items() if is_there)
    model = "fisheye" if kind == "fisheye" else f"with {terms}"
    return fit_lens(distorted_and_skewed, start, f"Metashape {model} of sensor {name}", where)


def _calibration_metashape(sensor: _Element, where: str) -> tuple[_Element | None, tuple[int, int]]:
    """The adjusted calibration, otherwise the first one, and the size of the picture."""
    found = sorted(sensor.findall("calibration"), key=lambda one: one.get("class") != "adjusted")
    calibration = found[0] if found else None
    for owner in (calibration, sensor):
        resolution = None if owner is None else owner.find("resolution")
        if resolution is None:
            continue
        texts = resolution.get("width", ""), resolution.get("height", "")
        if all(text.isdecimal() and len(text) <= 6 and int(text) > 0 for text in texts):
            return calibration, (int(texts[0]), int(texts[1]))
    raise CaptureError(f"{where} has no resolution; expected its width and height in pixels")


def _properties(sensor: _Element) -> dict[str | None, str]:
    return {element.get("name"): element.get("value", "") for element in sensor.findall("property")}
