"""Poses of Agisoft Metashape: the XML of File > Export > Export Cameras.

A camera's matrix leads from the camera (OpenCV axes) to its component; the component's or the chunk's similarity leads
to the world, often geocentric (metres from the middle of the Earth).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.metashape_lens import metashape_lens
from unmix_plugin.captures.poses.pose_set import Lens, PoseSet
from unmix_plugin.captures.poses.raw_poses import RawCamera, make_pose_set
from unmix_plugin.captures.poses.rigid import FLIP, name_some
from unmix_plugin.captures.poses.xml_text import numbers_of
from unmix_plugin.errors import CaptureError, counted

EARTH_RADII = (6.2e6, 6.6e6)
"""Metres from the middle of the Earth between which a position is geocentric."""


def read_metashape(path: Path, root: ElementTree.Element) -> PoseSet:
    """Poses of all enabled cameras with a transform, in or out of groups.

    Raises:
        CaptureError: no chunk, no aligned camera, several components without a common world, or a lens that can't be
            represented.
    """
    chunks = [chunk for chunk in root.iter("chunk") if chunk.get("enabled", "true") != "false"]
    chunks = [chunk for chunk in chunks if chunk.find("cameras") is not None]
    if not chunks:
        raise CaptureError(
            f"{path} has no chunk with cameras; expected Metashape's File > Export > Export Cameras"
        )
    chunk = max(chunks, key=lambda one: len(list(one.iter("camera"))))
    notes = [f"{len(chunks)} chunks; the one with the most cameras was read"] if len(chunks) > 1 else []
    aligned = _aligned(chunk, path, notes)
    worlds = _worlds(chunk, path)
    aligned = _of_one_world(aligned, worlds, notes)
    lenses = _lenses(chunk, {camera.get("sensor_id") for camera in aligned}, path, notes)
    raw = [
        RawCamera(
            camera.get("label") or f"camera {camera.get('id')}",
            _to_world(camera, worlds.get(camera.get("component_id"), worlds[None]), path),
            lenses.get(camera.get("sensor_id")),
        )
        for camera in aligned
    ]
    middle = np.mean([camera.matrix[:, 3] for camera in raw], axis=0)
    is_geocentric = EARTH_RADII[0] < np.linalg.norm(middle) < EARTH_RADII[1]
    notes += ["coordinates are geocentric; up is away from the Earth's middle"] if is_geocentric else []
    has_world = any(np.abs(world - np.eye(4)).max() > 0 for world in worlds.values())
    up = middle if is_geocentric else np.array([0.0, 0.0, 1.0]) if has_world else None
    return make_pose_set(raw, f"Metashape's {path.name}", str(path), None, up, dict.fromkeys(notes))


def _aligned(chunk: ElementTree.Element, path: Path, notes: list[str]) -> list[ElementTree.Element]:
    cameras = [camera for group in chunk.findall("cameras") for camera in group.iter("camera")]
    enabled = [camera for camera in cameras if camera.get("enabled", "true") != "false"]
    if len(enabled) < len(cameras):
        notes.append(f"{counted(len(cameras) - len(enabled), 'disabled camera')} left out")
    aligned = [camera for camera in enabled if camera.find("transform") is not None]
    missing = [camera.get("label", "?") for camera in enabled if camera.find("transform") is None]
    if not aligned:
        raise CaptureError(
            f"{path}: none of {len(cameras)} cameras is enabled and has a transform; align photos in Metashape first"
        )
    if missing:
        slaves = any(camera.get("master_id") for camera in enabled if camera.find("transform") is None)
        why = (
            ", some of them lenses of a rig, whose places beside the first lens are not read"
            if slaves
            else ""
        )
        notes.append(f"{counted(len(missing), 'camera')} without transform{why}: {name_some(missing)}")
    return aligned


def _worlds(chunk: ElementTree.Element, path: Path) -> dict[str | None, Float64[np.ndarray, "4 4"]]:
    """Similarities to the world by component; None is the chunk's own, the identity without one."""
    worlds: dict[str | None, Float64[np.ndarray, "4 4"]] = {None: np.eye(4)}
    if (own := chunk.find("transform")) is not None:
        worlds[None] = _similarity(own, path)
    for component in chunk.iterfind("components/component"):
        if (own := component.find("transform")) is not None:
            worlds[component.get("id")] = _similarity(own, path)
    return worlds


def _similarity(element: ElementTree.Element, path: Path) -> Float64[np.ndarray, "4 4"]:
    """rotation, translation and scale of an element, or its 16 numbers."""
    where = str(path)
    if len(element) == 0:
        values = numbers_of(element, 16, where)
        return np.eye(4) if values is None else values.reshape(4, 4)
    parts = (
        numbers_of(element.find(tag), count, where) for tag, count in (("rotation", 9), ("translation", 3))
    )
    rotation, translation = parts
    scale = numbers_of(element.find("scale"), 1, where)
    matrix = np.eye(4)
    matrix[:3, :3] = (1.0 if scale is None else scale[0]) * (
        np.eye(3) if rotation is None else rotation.reshape(3, 3)
    )
    matrix[:3, 3] = 0.0 if translation is None else translation
    return matrix


def _of_one_world(
    cameras: list[ElementTree.Element],
    worlds: dict[str | None, Float64[np.ndarray, "4 4"]],
    notes: list[str],
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


def _to_world(
    camera: ElementTree.Element, world: Float64[np.ndarray, "4 4"], path: Path
) -> Float64[np.ndarray, "3 4"]:
    where = f"{path}: camera {camera.get('label')}"
    values = numbers_of(camera.find("transform"), 16, where)
    if values is None:
        raise CaptureError(f"{where}: <transform> is empty; expected 16 numbers")
    scale = np.cbrt(np.abs(np.linalg.det(world[:3, :3]))) or 1.0
    matrix = world @ values.reshape(4, 4)
    return np.column_stack([matrix[:3, :3] / scale @ FLIP, matrix[:3, 3]])


def _lenses(
    chunk: ElementTree.Element, used: set[str | None], path: Path, notes: list[str]
) -> dict[str | None, Lens | None]:
    lenses: dict[str | None, Lens | None] = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        if sensor.get("id") in used:
            lenses[sensor.get("id")], said = metashape_lens(sensor, str(path))
            notes += said
    return lenses
