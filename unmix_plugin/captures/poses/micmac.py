"""Poses of MicMac: Orientation-IMAGE.xml files, each with its calibration inside or in a file beside it.

Rotations lead from camera (OpenCV axes) to world. Distortion is in pixels about its own centre and acts on ideal
pixels. Pixels are counted from the centre of the first one.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.poses.lens import Lens, Points, fit_lens
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    find_offset,
    load_xml,
    make_pose_set,
    number_of,
    numbers_of,
)
from unmix_plugin.errors import CaptureError

_PREFIX = "Orientation-"
_CONVENTION = "eConvApero_DistM2C"


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
    lenses: dict[str, Lens] = {}
    notes: list[str] = []
    raw = []
    for path in paths:
        root = load_xml(path)
        orientation = root if root.tag == "OrientationConique" else root.find("OrientationConique")
        if orientation is None:
            raise CaptureError(f"{path} holds no <OrientationConique> of MicMac")
        lens = _lens_micmac(orientation, path, lenses, notes)
        name = path.name.removeprefix(_PREFIX).removesuffix(".xml")
        raw.append((name, PosedCamera(_matrix(orientation, str(path)), lens)))
    is_far = find_offset(np.stack([camera.camera_to_world[:, 3] for _, camera in raw])).any()
    up = np.array([0.0, 0.0, 1.0]) if is_far else None
    folder = paths[0].parent
    return make_pose_set(raw, f"MicMac's {folder.name}", str(folder), None, up, dict.fromkeys(notes))


def _matrix(orientation: ElementTree.Element, where: str) -> Float64[np.ndarray, "3 4"]:
    convention = (
        orientation.findtext("ConvOri/KnownConv") or orientation.findtext("Externe/KnownConv") or _CONVENTION
    )
    if convention.strip() != _CONVENTION:
        raise CaptureError(f"{where} has the convention {convention.strip()}; expected {_CONVENTION}")
    center = numbers_of(orientation.find("Externe/Centre"), 3, where)
    code = orientation.find("Externe/ParamRotation/CodageMatr")
    rows = [None if code is None else numbers_of(code.find(tag), 3, where) for tag in ("L1", "L2", "L3")]
    if center is None or any(row is None for row in rows):
        raise CaptureError(f"{where}: <Centre> or the rotation's <L1>, <L2>, <L3> are missing")
    return np.column_stack([np.array(rows) @ FLIP, center])


def _lens_micmac(
    orientation: ElementTree.Element, path: Path, lenses: dict[str, Lens], notes: list[str]
) -> Lens:
    inner = orientation.find("Interne")
    name = (orientation.findtext("FileInterne") or "").strip()
    key = name if inner is None else str(path)
    if key not in lenses:
        where = str(path)
        if inner is None:
            file = path.parent / Path(name.replace("\\", "/")).name  # whatever folder it was written in
            if not name or not file.is_file():
                raise CaptureError(f"{path} names the calibration {name!r}; copy it into {path.parent}")
            where, root = str(file), load_xml(file)
            inner = root if root.tag == "CalibrationInternConique" else root.find("CalibrationInternConique")
        if inner is None:
            raise CaptureError(f"{where} holds no <CalibrationInternConique> of MicMac")
        lenses[key], said = _calibration_micmac(inner, where)
        notes += said
    return lenses[key]


def _calibration_micmac(inner: ElementTree.Element, where: str) -> tuple[Lens, list[str]]:
    center, size = numbers_of(inner.find("PP"), 2, where), numbers_of(inner.find("SzIm"), 2, where)
    focal = number_of(inner, "F", where)
    if center is None or size is None or focal <= 0 or size.min() < 1 or size.max() > 1e6:
        raise CaptureError(f"{where}: <PP>, <F> or <SzIm> are missing or not above 0")
    width, height = (int(side) for side in size)
    start = Lens(width, height, (focal, focal), (float(center[0]) + 0.5, float(center[1]) + 0.5))
    bends = [
        model for holder in inner.findall("CalibDistortion") for model in holder if model.tag != "ModNoDist"
    ]
    unknown = [model.tag for model in bends if model.tag not in ("ModRad", "ModPhgrStd")]
    if unknown:
        raise CaptureError(
            f"{where}: the distortion {unknown[0]} is not supported; calibrate with RadialStd or Fraser, or use Drunk"
        )
    if not bends:
        return start, []

    def project(ideal: Points) -> Points:
        pixels = focal * ideal + center
        for model in reversed(bends):
            pixels = _bend(pixels, model, where)
        return pixels + 0.5

    lens, note = fit_lens(project, start, " and ".join(model.tag for model in bends), where)
    return lens, [note]


def _bend(pixels: Points, model: ElementTree.Element, where: str) -> Points:
    """ModRad: radial terms of r^2, r^4, ... about a centre; ModPhgrStd adds P1, P2, b1, b2."""
    radial = model if model.tag == "ModRad" else model.find("RadiaPart")
    middle = None if radial is None else numbers_of(radial.find("CDist"), 2, where)
    if radial is None or middle is None:
        raise CaptureError(f"{where}: <{model.tag}> has no centre <CDist>; the file is damaged")
    terms = [numbers_of(element, 1, where) for element in radial.findall("CoeffDist")]
    away = pixels - middle
    squared = (away**2).sum(axis=1)
    factor = 1.0 + sum(
        term[0] * squared ** (power + 1) for power, term in enumerate(terms) if term is not None
    )
    x, y = away.T
    p1, p2, b1, b2 = (number_of(model, tag, where) for tag in ("P1", "P2", "b1", "b2"))
    bent_x = x * factor + p1 * (squared + 2 * x**2) + 2 * p2 * x * y + b1 * x + b2 * y
    bent_y = y * factor + p2 * (squared + 2 * y**2) + 2 * p1 * x * y
    return np.column_stack([bent_x, bent_y]) + middle
