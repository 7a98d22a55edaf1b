"""Poses of programs that write XML.

Agisoft Metashape: the XML of File > Export > Export Cameras.

A camera's matrix leads from the camera (OpenCV axes) to its component; the component's or the chunk's similarity leads
to the world, often geocentric (metres from the middle of the Earth).

A sensor's lens: u = w / 2 + cx + x' f + x' b1 + y' b2, v = h / 2 + cy + y' f, with x', y' bent by k1..k4 and by p1, p2,
which are OpenCV's p2, p1. PhotoScan up to 1.3 wrote fx and fy in place of f, which is refused by name.

MicMac: Orientation-IMAGE.xml files, each with its calibration inside or in a file beside it.

Rotations lead from camera (OpenCV axes) to world. Distortion is in pixels about its own centre and acts on ideal
pixels; <OrIntImaM2C> moves what comes of it to where it is in a picture that was cut. Pixels are counted from the
centre of the first one.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.lens import (
    Lens,
    Points,
    bend_agisoft,
    bend_brown,
    bend_equirectangular,
    bent_lens,
    fit_lens,
)
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    find_offset,
    load_xml,
    make_pose_set,
)
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.scenes.reading.faults import find_named

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
        if (own := owner.find("transform")) is not None:
            worlds[component] = _similarity(own, str(path))
    aligned = _of_one_world(_aligned(chunk, path, notes), worlds, notes)
    used = {camera.get("sensor_id") for camera in aligned}
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
        world = worlds.get(camera.get("component_id"), worlds[None])
        values = _numbers_of(camera.find("transform"), 16, f"{path}: camera {camera.get('label')}")
        if values is None:
            raise CaptureError(f"{path}: camera {camera.get('label')}: <transform> is empty")
        scale = np.cbrt(np.abs(np.linalg.det(world[:3, :3]))) or 1.0
        matrix = world @ values.reshape(4, 4)
        pose = np.column_stack([matrix[:3, :3] / scale @ FLIP, matrix[:3, 3]])
        name = camera.get("label") or f"camera {camera.get('id')}"
        raw.append((name, PosedCamera(pose, lenses.get(camera.get("sensor_id")))))
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


def _aligned(chunk: _Element, path: Path, notes: list[str]) -> list[_Element]:
    cameras = [camera for group in chunk.findall("cameras") for camera in group.iter("camera")]
    enabled = [camera for camera in cameras if _is_enabled(camera)]
    if len(enabled) < len(cameras):
        notes.append(f"{counted(len(cameras) - len(enabled), 'disabled camera')} left out")
    aligned = [camera for camera in enabled if camera.find("transform") is not None]
    if not aligned:
        raise CaptureError(
            f"{path}: none of {len(cameras)} cameras is enabled and has a transform; align photos first"
        )
    if missing := [camera for camera in enabled if camera.find("transform") is None]:
        of_rig = any(camera.get("master_id") for camera in missing)
        why = ", some of them lenses of a rig, whose places beside the first lens are not read" * of_rig
        named = name_some([camera.get("label", "?") for camera in missing])
        notes.append(f"{counted(len(missing), 'camera')} without transform{why}: {named}")
    return aligned


def _similarity(element: _Element, where: str) -> Float64[np.ndarray, "4 4"]:
    """rotation, translation and scale of an element, or its 16 numbers."""
    if len(element) == 0:
        values = _numbers_of(element, 16, where)
        return np.eye(4) if values is None else values.reshape(4, 4)
    rotation, translation = (
        _numbers_of(element.find(tag), count, where) for tag, count in (("rotation", 9), ("translation", 3))
    )
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation.reshape(3, 3)
    matrix[:3, :3] *= _number_of(element, "scale", where, default=1.0)
    matrix[:3, 3] = 0.0 if translation is None else translation
    return matrix


def _of_one_world(
    cameras: list[_Element], worlds: dict[str | None, Float64[np.ndarray, "4 4"]], notes: list[str]
) -> list[_Element]:
    """Cameras whose components share a world; without a transform, a component's world is its own."""
    by_component: dict[str | None, list[_Element]] = {}
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
        return bent_lens(bend_equirectangular, (), start, f"Metashape spherical of sensor {name}", where)
    if calibration is None:
        notes.append(f"sensor {name} is not calibrated: nominal focal length")
        calibration = _nominal_calibration(sensor)
    if calibration is None:
        return None
    if calibration.find("f") is None and calibration.find("fx") is not None:
        raise CaptureError(
            f"{where} has <fx> and <fy>, as PhotoScan up to 1.3 wrote them, which is not read; open the project in "
            "Metashape and use File > Export > Export Cameras"
        )
    values = {tag: _number_of(calibration, tag, where) for tag in _TERMS}
    f_x, f_y, skew = values["f"] + values["b1"], values["f"], values["b2"]
    if min(f_x, f_y) <= 0:
        raise CaptureError(f"{where} has the focal length {min(f_x, f_y):g}; expected pixels above 0")
    center_x, center_y = width / 2 + values["cx"], height / 2 + values["cy"]
    if not (0 <= center_x <= width and 0 <= center_y <= height):
        raise CaptureError(
            f"{where} has the principal point {center_x:g}, {center_y:g}, outside its {width} x {height} pixels; check "
            "<cx>, <cy> and <resolution> in the file"
        )
    notes += _unknown_terms(calibration, name)
    tangential = (values["p2"], values["p1"])
    start, growth = Lens(width, height, (f_x, f_y), (center_x, center_y)), (values["p3"], values["p4"])
    k1, k2, k3, k4 = (values[key] for key in _RADIAL)
    frame = replace(start, distortion=(k1, k2, *tangential), higher_radial=(k3, k4))
    more = {"b2": bool(skew), "p3, p4": any(growth) and any(tangential)}
    if kind == "frame" and not any(more.values()):
        return frame

    def bent_and_skewed(ideal: Points) -> Points:
        bent = bend_agisoft(ideal, frame.radial, tangential, growth, is_fisheye=kind == "fisheye")
        return bent @ np.array([[f_x, 0.0], [skew, f_y]]) + start.center_px

    terms = " and ".join(term for term, is_there in more.items() if is_there)
    model = "fisheye" if kind == "fisheye" else f"with {terms}"
    return fit_lens(bent_and_skewed, start, f"Metashape {model} of sensor {name}", where)


def _unknown_terms(calibration: _Element, name: str) -> list[str]:
    """A note that names numbers of a calibration that are not followed, if there are any."""
    unknown = []
    for child in calibration:
        with suppress(ValueError):
            if child.tag not in _TERMS and float(child.text or ""):
                unknown.append(child.tag)
    note = f"sensor {name}: numbers that are not known and not used: {name_some(unknown)}"
    return [note] if unknown else []


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


def _nominal_calibration(sensor: _Element) -> _Element | None:
    """By focal length and size of a pixel in mm; None where they are not given."""
    texts = _properties(sensor)
    try:
        focal, *sides = (float(texts[name]) for name in ("focal_length", "pixel_width", "pixel_height"))
    except (KeyError, ValueError):
        return None
    if not 0 < min(focal, *sides) <= max(focal, *sides) < np.inf:
        return None
    calibration = ElementTree.Element("calibration")
    across, down = (focal / side for side in sides)
    for tag, value in (("f", down), ("b1", across - down)):
        ElementTree.SubElement(calibration, tag).text = repr(value)
    return calibration


# MicMac.

_PREFIX = "Orientation-"
_CONVENTION, _PROJECTION = "eConvApero_DistM2C", "eProjStenope"
_Shift: TypeAlias = tuple[float, float]
_AFFINITY_TOLERANCE = 1e-6
"""Of an affinity's axes from those of the identity, which moves no pixel by a tenth."""


def find_orientations(folder: Path) -> list[Path]:
    """Orientation files of a folder, otherwise of the only folder `Ori-...` in it."""
    own = sorted(folder.glob(f"{_PREFIX}*.xml"))
    below = [sorted(place.glob(f"{_PREFIX}*.xml")) for place in sorted(folder.glob("Ori-*"))]
    below = [files for files in below if files]
    if own or not below:
        return own
    if len(below) > 1:
        names = ", ".join(files[0].parent.name for files in below)
        raise CaptureError(f"{folder} has several orientations: {names}; give the folder of one")
    return below[0]


def read_micmac(paths: list[Path]) -> PoseSet:
    """Poses of orientation files. Raises CaptureError: a file is damaged, of another convention, or its calibration is
    missing or can't be represented."""
    lenses: dict[tuple[str, _Shift], Lens] = {}
    raw = []
    for path in paths:
        orientation = _element_micmac(path, "OrientationConique")
        lens = _lens_micmac(orientation, path, lenses)
        name = path.name.removeprefix(_PREFIX).removesuffix(".xml")
        raw.append((name, PosedCamera(_pose_micmac(orientation, str(path)), lens)))
    is_far = find_offset(np.stack([camera.camera_to_world[:, 3] for _, camera in raw])).any()
    up = np.array([0.0, 0.0, 1.0]) if is_far else None
    folder = paths[0].parent
    return make_pose_set(raw, f"MicMac's {folder.name}", str(folder), None, up)


def _element_micmac(path: Path, tag: str) -> _Element:
    """The element of a file that has it as its root, or below."""
    root = load_xml(path)
    found = root if root.tag == tag else root.find(tag)
    if found is None:
        raise CaptureError(f"{path} holds no <{tag}> of MicMac")
    return found


def _pose_micmac(orientation: _Element, where: str) -> Float64[np.ndarray, "3 4"]:
    stated = [orientation.findtext(f"{holder}/KnownConv") for holder in ("ConvOri", "Externe")]
    _require_known("convention", next(filter(None, stated), None), _CONVENTION, where)
    _require_known("projection", orientation.findtext("TypeProj"), _PROJECTION, where)
    center = _numbers_of(orientation.find("Externe/Centre"), 3, where)
    code = orientation.find("Externe/ParamRotation/CodageMatr")
    rows = [None if code is None else _numbers_of(code.find(tag), 3, where) for tag in ("L1", "L2", "L3")]
    if center is None or any(row is None for row in rows):
        raise CaptureError(f"{where}: <Centre> or the rotation's <L1>, <L2>, <L3> are missing")
    return np.column_stack([np.array(rows) @ FLIP, center])


def _require_known(what: str, found: str | None, expected: str, where: str) -> None:
    """Refuse what an element of MicMac names, unless it names the one that we follow, or is absent."""
    name = (found or "").strip()
    if name not in ("", expected):
        raise CaptureError(f"{where} has the {what} {name}; expected {expected}")


def _lens_micmac(orientation: _Element, path: Path, lenses: dict[tuple[str, _Shift], Lens]) -> Lens:
    inner = orientation.find("Interne")
    name = (orientation.findtext("FileInterne") or "").strip()
    shift = _shift_micmac(orientation.find("OrIntImaM2C"), str(path))
    key = (name if inner is None else str(path), shift)
    if key not in lenses:
        file: Path | None = path
        if inner is None:  # in a file, whatever folder that was in
            file = find_named(path.parent, name.replace("\\", "/").rpartition("/")[2])
            if file is None:
                raise CaptureError(f"{path} names the calibration {name!r}; copy it into {path.parent}")
            inner = _element_micmac(file, "CalibrationInternConique")
        lens = _calibration_micmac(inner, str(file))
        lenses[key] = _cut_micmac(lens, inner, shift, str(file)) if any(shift) else lens
    return lenses[key]


def _shift_micmac(affinity: _Element | None, where: str) -> _Shift:
    """Pixels x and y that an affinity adds to those of the calibration; CaptureError where it does more."""
    if affinity is None:
        return 0.0, 0.0
    shift, *axes = (_numbers_of(affinity.find(tag), 2, where) for tag in ("I00", "V10", "V01"))
    if shift is None or any(axis is None for axis in axes):
        raise CaptureError(f"{where}: <{affinity.tag}> lacks <I00>, <V10> or <V01>; the file is damaged")
    if np.abs(np.array(axes) - np.eye(2)).max() > _AFFINITY_TOLERANCE:
        raise CaptureError(
            f"{where}: <{affinity.tag}> turns or stretches the picture, which is not supported; resample scanned "
            "pictures (ReSampFid) and orient them again"
        )
    return float(shift[0]), float(shift[1])


def _cut_micmac(lens: Lens, inner: _Element, shift: _Shift, where: str) -> Lens:
    """The lens of a picture cut out of the calibrated one, as ClipChantier does: <SzIm> stays that of the whole."""
    size = _numbers_of(inner.find("PixelSzIm"), 2, where)
    if size is None or size.min() < 1 or size.max() > 1e6:
        raise CaptureError(
            f"{where}: <OrIntImaM2C> says that the picture was cut, and no <PixelSzIm> of the calibration how large it "
            "is; add its width and height"
        )
    return lens.seen_as(int(size[0]), int(size[1]), (-shift[0], -shift[1]), (1.0, 1.0))


def _calibration_micmac(inner: _Element, where: str) -> Lens:
    _require_known("convention", inner.findtext("KnownConv"), _CONVENTION, where)
    if any(_shift_micmac(inner.find("OrIntGlob/Affinite"), where)):
        raise CaptureError(
            f"{where}: <OrIntGlob> moves the picture against its calibration, which is not supported; calibrate "
            "pictures as they are"
        )
    center, size = _numbers_of(inner.find("PP"), 2, where), _numbers_of(inner.find("SzIm"), 2, where)
    focal = _number_of(inner, "F", where)
    if center is None or size is None or focal <= 0 or size.min() < 1 or size.max() > 1e6:
        raise CaptureError(f"{where}: <PP>, <F> or <SzIm> are missing or not above 0")
    width, height = (int(side) for side in size)
    start = Lens(width, height, (focal, focal), (float(center[0]) + 0.5, float(center[1]) + 0.5))
    bends = [model for model in inner.iterfind("CalibDistortion/*") if model.tag != "ModNoDist"]
    unknown = [model.tag for model in bends if model.tag not in ("ModRad", "ModPhgrStd")]
    if unknown:
        raise CaptureError(
            f"{where}: the distortion {unknown[0]} is not supported; calibrate with RadialStd or Fraser, or use Drunk"
        )
    if not bends:
        return start

    def project(ideal: Points) -> Points:
        pixels = focal * ideal + center
        for model in reversed(bends):
            pixels = _bend(pixels, model, where)
        return pixels + 0.5

    return fit_lens(project, start, " and ".join(model.tag for model in bends), where)


def _bend(pixels: Points, model: _Element, where: str) -> Points:
    """ModRad: radial terms of r^2, r^4, ... about a centre; ModPhgrStd adds P1, P2, b1, b2."""
    radial = model if model.tag == "ModRad" else model.find("RadiaPart")
    middle = None if radial is None else _numbers_of(radial.find("CDist"), 2, where)
    if radial is None or middle is None:
        raise CaptureError(f"{where}: <{model.tag}> has no centre <CDist>; the file is damaged")
    found = [_numbers_of(element, 1, where) for element in radial.findall("CoeffDist")]
    terms = [0.0 if term is None else float(term[0]) for term in found]
    p1, p2, b1, b2 = (_number_of(model, tag, where) for tag in ("P1", "P2", "b1", "b2"))
    away = pixels - middle
    return bend_brown(away, terms, (p2, p1)) + away @ np.array([[b1, 0.0], [b2, 0.0]]) + middle


# Numbers in XML.


def _numbers_of(element: _Element | None, count: int, where: str) -> Float64[np.ndarray, " count"] | None:
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


def _number_of(parent: _Element, tag: str, where: str, default: float = 0.0) -> float:
    """The number in a child; the default without one."""
    values = _numbers_of(parent.find(tag), 1, where)
    return default if values is None else float(values[0])
