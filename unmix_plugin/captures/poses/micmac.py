"""Poses of MicMac: Orientation-IMAGE.xml files, each with its calibration inside or in a file beside it.

Rotations lead from camera (OpenCV axes) to world. Distortion is in pixels about its own centre and acts on ideal
pixels; <OrIntImaM2C> moves what comes of it to where it is in a picture that was cut. Pixels are counted from the
centre of the first one.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np

from unmix_plugin.captures.poses.lens import Lens, Points, distort_brown, fit_lens
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    find_offset,
    load_xml,
    make_pose_set,
    number_in,
    numbers_in,
)
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.faults import find_named

_Element = ElementTree.Element

_PREFIX = "Orientation-"
_CONVENTION, _PROJECTION = "eConvApero_DistM2C", "eProjStenope"
_Shift: TypeAlias = tuple[float, float]
_AFFINITY_TOLERANCE = 1e-6
"""Of an affinity's axes from those of the identity, which moves no pixel by a tenth."""


def find_orientations(folder: Path) -> list[Path]:
    """Orientation files of a folder, otherwise of the only folder `Ori-...` in it."""
    inside = sorted(folder.glob(f"{_PREFIX}*.xml"))
    below = [sorted(place.glob(f"{_PREFIX}*.xml")) for place in sorted(folder.glob("Ori-*"))]
    below = [files for files in below if files]
    if inside or not below:
        return inside
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
        where, name = str(path), path.name.removeprefix(_PREFIX).removesuffix(".xml")
        stated = [orientation.findtext(f"{holder}/KnownConv") for holder in ("ConvOri", "Externe")]
        _require_known("convention", next(filter(None, stated), None), _CONVENTION, where)
        _require_known("projection", orientation.findtext("TypeProj"), _PROJECTION, where)
        center = numbers_in(orientation.find("Externe/Centre"), 3, where)
        code = orientation.find("Externe/ParamRotation/CodageMatr")
        rows = [None if code is None else numbers_in(code.find(tag), 3, where) for tag in ("L1", "L2", "L3")]
        if center is None or any(row is None for row in rows):
            raise CaptureError(f"{where}: <Centre> or the rotation's <L1>, <L2>, <L3> are missing")
        raw.append((name, PosedCamera(np.column_stack([np.array(rows) @ FLIP, center]), lens)))
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
        if any(
            shift
        ):  # a picture cut out of the calibrated one, as ClipChantier does: <SzIm> stays that of the whole
            size = numbers_in(inner.find("PixelSzIm"), 2, str(file))
            if size is None or size.min() < 1 or size.max() > 1e6:
                raise CaptureError(
                    f"{file}: <OrIntImaM2C> says that the picture was cut, and no <PixelSzIm> of the calibration how "
                    "large it is; add its width and height"
                )
            lens = lens.seen_as(int(size[0]), int(size[1]), (-shift[0], -shift[1]), (1.0, 1.0))
        lenses[key] = lens
    return lenses[key]


def _shift_micmac(affinity: _Element | None, where: str) -> _Shift:
    """Pixels x and y that an affinity adds to those of the calibration; CaptureError where it does more."""
    if affinity is None:
        return 0.0, 0.0
    shift, *axes = (numbers_in(affinity.find(tag), 2, where) for tag in ("I00", "V10", "V01"))
    if shift is None or any(axis is None for axis in axes):
        raise CaptureError(f"{where}: <{affinity.tag}> lacks <I00>, <V10> or <V01>; the file is damaged")
    if np.abs(np.array(axes) - np.eye(2)).max() > _AFFINITY_TOLERANCE:
        raise CaptureError(
            f"{where}: <{affinity.tag}> turns or stretches the picture, which is not supported; resample scanned "
            "pictures (ReSampFid) and orient them again"
        )
    return float(shift[0]), float(shift[1])


def _calibration_micmac(inner: _Element, where: str) -> Lens:
    _require_known("convention", inner.findtext("KnownConv"), _CONVENTION, where)
    if any(_shift_micmac(inner.find("OrIntGlob/Affinite"), where)):
        raise CaptureError(
            f"{where}: <OrIntGlob> moves the picture against its calibration, which is not supported; calibrate "
            "pictures as they are"
        )
    center, size = numbers_in(inner.find("PP"), 2, where), numbers_in(inner.find("SzIm"), 2, where)
    focal = number_in(inner, "F", where)
    if center is None or size is None or focal <= 0 or size.min() < 1 or size.max() > 1e6:
        raise CaptureError(f"{where}: <PP>, <F> or <SzIm> are missing or not above 0")
    width, height = (int(side) for side in size)
    start = Lens(width, height, (focal, focal), (float(center[0]) + 0.5, float(center[1]) + 0.5))
    distortions = [model for model in inner.iterfind("CalibDistortion/*") if model.tag != "ModNoDist"]
    unknown = [model.tag for model in distortions if model.tag not in ("ModRad", "ModPhgrStd")]
    if unknown:
        raise CaptureError(
            f"{where}: the distortion {unknown[0]} is not supported; calibrate with RadialStd or Fraser, or use Drunk"
        )
    if not distortions:
        return start

    def project(ideal: Points) -> Points:
        pixels = focal * ideal + center
        for model in reversed(distortions):
            pixels = _distort(pixels, model, where)
        return pixels + 0.5

    return fit_lens(project, start, " and ".join(model.tag for model in distortions), where)


def _distort(pixels: Points, model: _Element, where: str) -> Points:
    """ModRad: radial terms of r^2, r^4, ... about a centre; ModPhgrStd adds P1, P2, b1, b2."""
    radial = model if model.tag == "ModRad" else model.find("RadiaPart")
    middle = None if radial is None else numbers_in(radial.find("CDist"), 2, where)
    if radial is None or middle is None:
        raise CaptureError(f"{where}: <{model.tag}> has no centre <CDist>; the file is damaged")
    found = [numbers_in(element, 1, where) for element in radial.findall("CoeffDist")]
    terms = [0.0 if term is None else float(term[0]) for term in found]
    p1, p2, b1, b2 = (number_in(model, tag, where) for tag in ("P1", "P2", "b1", "b2"))
    away = pixels - middle
    return distort_brown(away, terms, (p2, p1)) + away @ np.array([[b1, 0.0], [b2, 0.0]]) + middle
