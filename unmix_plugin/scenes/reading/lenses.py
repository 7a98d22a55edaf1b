"""The lens of a frame in transforms.json: focal lengths, principal point and distortion, by the keys in use.

Keys of a frame come before those of the whole scene. nerfstudio reads a lens key of a frame only where the scene has
none, so a warning says where both are given and differ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from unmix_plugin.limits import GREATEST_PX
from unmix_plugin.scenes.reading.faults import Faults, describe, read_numbers, read_within
from unmix_plugin.scenes.reading.foreign_keys import refused_keys

_SUPPORTED_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")
_BENDING_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Also the order of nerfstudio's `distortion_params`."""
_FOCAL_KEYS = ("fl_x", "fl_y")
_ANGLES = (("camera_angle_x", "x_fov"), ("camera_angle_y", "y_fov"))
"""Keys of the field of view along x and along y, in radians and in degrees."""
_RANGES = (
    (("w", "h"), 1.0, GREATEST_PX, "a whole number of pixels"),
    (_FOCAL_KEYS, 1 / GREATEST_PX, GREATEST_PX, "a focal length above 0 in pixels"),
    (("camera_angle_x", "camera_angle_y"), 1e-6, math.pi - 1e-6, "radians between 0 and pi"),
    (("x_fov", "y_fov"), 1e-4, 180 - 1e-4, "degrees between 0 and 180"),
    (("cx", "cy", *_BENDING_KEYS), -GREATEST_PX, GREATEST_PX, "a finite number, at most 1e9"),
)
"""Keys of numbers, the least and the greatest, and what messages call them."""


@dataclass(frozen=True)
class Intrinsics:
    """Lens of one frame. Sizes in pixels; None where the file says nothing."""

    model: Any
    """What `camera_model` or `is_fisheye` says; OPENCV where they are absent. Only `read_intrinsics` refuses models."""
    width: int | None
    height: int | None
    focal_px: tuple[float | None, float | None]
    """Along x and y."""
    angles: tuple[float | None, float | None]
    """Fields of view along x and y, radians."""
    center_px: tuple[float | None, float | None]
    """None is the middle of the image."""
    distortion: tuple[float, float, float, float]
    """k1, k2, p1, p2."""
    higher_radial: tuple[float, float]
    """k3, k4: radial terms of the sixth and eighth power."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """k1, k2, p1, p2, and k3, k4 where one of them is not 0."""
        return (*self.distortion, *(self.higher_radial if any(self.higher_radial) else ()))

    def focal_at(self, width: int, height: int, is_line: bool = False) -> tuple[float, float] | None:
        """Focal lengths x, y in pixels of an image of this size; None if the file gives none.

        Each is the one given, or follows from the field of view, or is that of the other axis. A line camera
        (`is_line`) has that of x along both: where one pose stands for the view, its pixels are square.
        """
        x, y = (
            focal if focal is not None or angle is None else 0.5 * side / math.tan(0.5 * angle)
            for focal, angle, side in zip(self.focal_px, self.angles, (width, height), strict=True)
        )
        x, y = y if x is None else x, x if y is None else y
        return None if x is None or y is None else (x, x if is_line else y)


def read_lens(
    content: dict[str, Any], frame: dict[str, Any], where: str, faults: Faults, is_scene: bool = False
) -> Intrinsics | None:
    """The lens keys of a frame of any transforms.json, whatever its model and whether or not it has a focal length.

    For every reader of such files: numbers are finite, sizes whole, focal lengths above 0, angles between 0 and pi.

    Args:
        content: The whole file, whose keys hold for frames that lack them.
        frame: Keys of the frame.
        where: How messages call the frame.
        faults: Where faults are noted.
        is_scene: Whether rays are cast through the lens as it is.
    Returns:
        None, with noted faults, if a number is impossible.
    """
    noted_before = faults.noted
    own, common = (_lens_keys(one, where, faults) for one in (frame, content))
    for message in refused_keys(common, own, is_scene):
        faults.add(where, message)
    common = _not_overridden(common, own)
    numbers: dict[str, float | None] = {}
    for keys, low, high, expected in _RANGES:
        for key in keys:
            source, owner = (own, where) if key in own else (common, faults.file)
            is_whole = key in ("w", "h")
            numbers[key] = read_within(source, key, low, high, expected, owner, faults, is_whole)
    model = _read_model(common | own, where, faults)
    if faults.noted > noted_before:
        return None
    width, height = (None if side is None else int(side) for side in (numbers["w"], numbers["h"]))
    x_fov, y_fov = (
        None if field is None else math.radians(field) for field in (numbers["x_fov"], numbers["y_fov"])
    )
    k1, k2, k3, k4, p1, p2 = (numbers[key] or 0.0 for key in _BENDING_KEYS)
    return Intrinsics(
        model,
        width,
        height,
        focal_px=(numbers["fl_x"], numbers["fl_y"]),
        angles=(numbers["camera_angle_x"] or x_fov, numbers["camera_angle_y"] or y_fov),
        center_px=(numbers["cx"], numbers["cy"]),
        distortion=(k1, k2, p1, p2),
        higher_radial=(k3, k4),
    )


def _lens_keys(one: dict[str, Any], where: str, faults: Faults) -> dict[str, Any]:
    """Keys of a frame or of the scene that have a value, the lens by our own keys; of a field of view given twice, that
    in degrees, as in nerfstudio."""
    keys = _read_intrinsic_matrix(one.get("intrinsic_matrix"), where, faults)
    keys |= {key: value for key, value in one.items() if value is not None}
    keys |= _read_distortion_list(one.get("distortion_params"), where, faults)
    twice = [in_radians for in_radians, in_degrees in _ANGLES if in_degrees in keys]
    return {key: value for key, value in keys.items() if key not in twice}


def _not_overridden(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Keys of the scene, less those that would go before a field of view of the frame."""
    hidden = [key for names in _ANGLES if any(name in own for name in names) for key in names]
    if hidden and not any(key in own for key in _FOCAL_KEYS):
        hidden += _FOCAL_KEYS
    return {key: value for key, value in common.items() if key not in hidden}


def _read_model(lens: dict[str, Any], where: str, faults: Faults) -> Any:
    """The lens model: `camera_model`, or instant-ngp's `is_fisheye`; a fault where they contradict each other."""
    model = lens.get("camera_model")
    model = model.upper() if isinstance(model, str) else model
    if lens.get("is_fisheye"):
        if model not in (None, "OPENCV_FISHEYE"):
            faults.add(where, f"'is_fisheye' is true and camera_model {describe(model)}; drop one of them")
        return "OPENCV_FISHEYE"
    return "OPENCV" if model is None else model


def _read_intrinsic_matrix(matrix: Any, where: str, faults: Faults) -> dict[str, float]:
    """Focal lengths and principal point of NeuS2's `intrinsic_matrix`, by our keys; none where there is no matrix."""
    if matrix is None:
        return {}
    rows = matrix[:3] if isinstance(matrix, list) else []
    numbers = read_numbers([row[:3] if isinstance(row, list) else row for row in rows], 3, 3)
    if numbers is None:
        faults.add(where, f"'intrinsic_matrix' is {describe(matrix)}; expected 3 rows of 3 numbers in pixels")
        return {}
    (fx, skew, cx), (_, fy, cy), _ = numbers.tolist()
    if min(fx, fy) <= 0 or abs(skew) > 1e-6 * fx:
        found = f"focal lengths {fx:g}, {fy:g} and skew {skew:g}"
        faults.add(where, f"'intrinsic_matrix' has {found}; expected focal lengths above 0 and no skew")
        return {}
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}


def _read_distortion_list(listed: Any, where: str, faults: Faults) -> dict[str, float]:
    """The terms of `distortion_params` by our keys; none where there is no list."""
    if listed is None:
        return {}
    numbers = read_numbers(listed, len(_BENDING_KEYS))
    if numbers is None or np.abs(numbers).max() > GREATEST_PX:
        names = ", ".join(_BENDING_KEYS)
        faults.add(where, f"'distortion_params' is {describe(listed)}; expected the numbers {names}")
        return {}
    return dict(zip(_BENDING_KEYS, numbers.tolist(), strict=True))


def read_intrinsics(
    content: dict[str, Any], frame: dict[str, Any], where: str, faults: Faults
) -> Intrinsics | None:
    """As `read_lens`, for lenses that rays are cast through; None and noted faults if it is not to be used."""
    noted_before = faults.noted
    lens = read_lens(content, frame, where, faults, is_scene=True)
    model = "OPENCV" if lens is None else lens.model
    if model not in _SUPPORTED_MODELS:
        faults.add(
            where if frame.get("camera_model") is not None else faults.file,
            f"camera_model {describe(model)} is not supported; expected one of {', '.join(_SUPPORTED_MODELS)}: "
            "unmix-process brings such pictures into an OPENCV lens",
        )
    focal_keys = ("fl_x", "camera_angle_x", "x_fov", "intrinsic_matrix")
    if all(source.get(key) is None for source in (frame, content) for key in focal_keys):
        faults.add(where, "'fl_x' is absent; expected the focal length in pixels, of a frame or the scene")
    if lens is not None and model in ("PINHOLE", "SIMPLE_PINHOLE") and any(lens.coefficients):
        (k1, k2, p1, p2), (k3, k4) = lens.distortion, lens.higher_radial
        bending = dict(zip(_BENDING_KEYS, (k1, k2, k3, k4, p1, p2), strict=True))
        faults.add(where, f"camera_model {model} comes with distortion {bending}; expected OPENCV or zeros")
    return None if faults.noted > noted_before else lens
