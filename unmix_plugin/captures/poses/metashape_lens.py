"""Metashape's sensors as our lens.

u = w / 2 + cx + x' f + x' b1 + y' b2, v = h / 2 + cy + y' f, with x', y' bent by k1..k4 and by p1, p2, which are
OpenCV's p2, p1.
"""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from unmix_plugin.captures.poses.lens_fit import Points, fit_lens, project_fisheye, project_opencv
from unmix_plugin.captures.poses.pose_set import Lens
from unmix_plugin.captures.poses.xml_text import number_of
from unmix_plugin.errors import CaptureError

RADIAL = ("k1", "k2", "k3", "k4")


def metashape_lens(sensor: ElementTree.Element, where: str) -> tuple[Lens | None, list[str]]:
    """The lens of a sensor, None without any focal length; and what is not exactly as in the file.

    Raises:
        CaptureError: it is not a frame or fisheye camera, or the nearest lens is off by more than half a pixel.
    """
    name = sensor.get("label", "?")
    where = f"{where}: sensor {name}"
    calibration, size = _calibration(sensor, where)
    if calibration is None:
        return _from_physical(sensor, size), [f"sensor {name} is not calibrated: nominal focal length"]
    kind = calibration.get("type") or sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise CaptureError(
            f"{where} is of the type {kind}; expected frame or fisheye: export undistorted photos"
        )
    width, height = size
    values = {
        tag: number_of(calibration, tag, where) for tag in ("f", "cx", "cy", "b1", "b2", "p1", "p2", *RADIAL)
    }
    f_x = number_of(calibration, "fx", where, values["f"] + values["b1"])
    f_y = number_of(calibration, "fy", where, values["f"])
    skew = number_of(calibration, "skew", where, values["b2"])
    if min(f_x, f_y) <= 0:
        raise CaptureError(f"{where} has the focal length {min(f_x, f_y):g}; expected pixels above 0")
    focal, center = (f_x, f_y), (width / 2 + values["cx"], height / 2 + values["cy"])
    radial = tuple(values[key] for key in RADIAL)
    tangential = (values["p2"], values["p1"])
    if kind == "frame" and not skew:
        bends = (radial[0], radial[1], *tangential), (radial[2], radial[3])
        return Lens(width, height, focal, center, *bends), []

    def project(ideal: Points) -> Points:
        if kind == "fisheye":
            bent = project_fisheye(ideal, (1.0, 1.0), (0.0, 0.0), radial)
        else:
            bent = project_opencv(ideal, (1.0, 1.0), (0.0, 0.0), radial, tangential)
        return bent * focal + np.column_stack([skew * bent[:, 1], np.zeros(len(bent))]) + center

    model = "Metashape fisheye" if kind == "fisheye" else "Metashape with b2"
    fitted, note = fit_lens(project, Lens(width, height, focal, center), model, where)
    return fitted, [f"sensor {name}: {note}"]


def _calibration(
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
