"""Lenses of transforms.json: keys of a frame, otherwise those of the whole file (nerfstudio's rule)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from unmix_plugin.captures.poses.lens_fit import fit_lens, project_fisheye
from unmix_plugin.captures.poses.pose_set import Lens
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.faults import describe, read_number

RADIAL_KEYS, TANGENTIAL_KEYS = ("k1", "k2", "k3", "k4"), ("p1", "p2")
PLAIN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_KEYS = (
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "w",
    "h",
    "camera_angle_x",
    "camera_angle_y",
    *RADIAL_KEYS,
    *TANGENTIAL_KEYS,
)

Numbers = Mapping[str, float | None]


def lens_numbers(values: Mapping[str, Any], where: str) -> dict[str, float | None]:
    """All numbers that a lens may have; None where they are absent.

    Raises:
        CaptureError: one is not a finite number.
    """
    numbers = {key: _number(values, key, where) for key in _KEYS}
    listed = values.get("distortion_params")
    if isinstance(listed, list) and len(listed) == 6:
        terms = dict(zip((*RADIAL_KEYS, *TANGENTIAL_KEYS), listed, strict=True))
        numbers |= {key: _number(terms, key, where) for key in terms}
    return numbers


def size_of(numbers: Numbers, where: str) -> tuple[int, int] | None:
    """Width and height; None where one is absent.

    Raises:
        CaptureError: no whole pixels above 0.
    """
    width, height = numbers["w"], numbers["h"]
    if width is None or height is None:
        return None
    if width < 1 or height < 1 or width != int(width) or height != int(height):
        raise CaptureError(f"{where}: 'w' and 'h' are {width:g}, {height:g}; expected whole pixels above 0")
    return int(width), int(height)


def make_lens(
    numbers: Numbers, model: Any, size: tuple[int, int], where: str
) -> tuple[Lens | None, str | None]:
    """The lens, None without a focal length, and a note if it is not exactly the one of the file.

    Raises:
        CaptureError: a number is impossible, or the model can't be represented.
    """
    focal = _focal(numbers, size, where)
    if focal is None:
        return None, None
    center = (_or(numbers["cx"], size[0] / 2), _or(numbers["cy"], size[1] / 2))
    radial = tuple(_or(numbers[key], 0.0) for key in RADIAL_KEYS)
    p1, p2 = (_or(numbers[key], 0.0) for key in TANGENTIAL_KEYS)
    plain = Lens(*size, focal, center)
    if model == "OPENCV_FISHEYE":
        return fit_lens(lambda ideal: project_fisheye(ideal, focal, center, radial), plain, model, where)
    if model not in PLAIN_MODELS:
        raise CaptureError(
            f"{where}: camera_model {describe(model)} is not supported; expected one of "
            f"{', '.join((*PLAIN_MODELS, 'OPENCV_FISHEYE'))}: undistort the images first"
        )
    return Lens(*size, focal, center, (radial[0], radial[1], p1, p2), (radial[2], radial[3])), None


def _focal(numbers: Numbers, size: Sequence[int], where: str) -> tuple[float, float] | None:
    focal: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        value, angle = numbers[f"fl_{axis}"], numbers[f"camera_angle_{axis}"]
        if value is None and angle is not None:
            if not 1e-6 < angle < math.pi - 1e-6:
                raise CaptureError(
                    f"{where}: 'camera_angle_{axis}' is {angle:g}; expected radians between 0 and pi"
                )
            value = 0.5 * side / math.tan(0.5 * angle)
        if value is not None and value <= 0:
            raise CaptureError(
                f"{where}: 'fl_{axis}' is {value:g}; expected a focal length above 0 in pixels"
            )
        focal.append(value)
    x, y = focal
    if x is None and y is None:
        return None
    return _or(x, _or(y, 0.0)), _or(y, _or(x, 0.0))


def _number(values: Mapping[str, Any], key: str, where: str) -> float | None:
    if values.get(key) is None:
        return None
    number = read_number(values[key])
    if number is None or abs(number) > 1e9:
        raise CaptureError(f"{where}: '{key}' is {describe(values[key])}; expected a finite number")
    return number


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
