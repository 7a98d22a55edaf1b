"""Lens and image size of a frame: keys of the frame, otherwise those of the whole scene (nerfstudio's rule)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.json_values import describe, read_number

SUPPORTED_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")
GREATEST_PX = 1e9
"""Of focal lengths and principal points; beyond, and below its inverse, float32 loses what is projected."""
SMALLEST_ANGLE = 1e-6
"""Field of view in radians that is still one, and how much less than pi it must be."""
BENDING_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Also the order of nerfstudio's `distortion_params`."""


@dataclass(frozen=True)
class Intrinsics:
    """Lens of one frame. Sizes in pixels; None where the cube decides."""

    width: int | None
    height: int | None
    focal_px: tuple[float, float] | None
    """None where `camera_angle_x` is given and the width not yet known."""
    angle_x: float | None
    """Horizontal field of view in radians."""
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

    def focal_at(self, width: int) -> tuple[float, float]:
        """Focal lengths x, y in pixels for images of this width."""
        if self.focal_px is not None:
            return self.focal_px
        focal = 0.5 * width / math.tan(0.5 * (self.angle_x or 1.0))
        return (focal, focal)


def read_intrinsics(
    content: dict[str, Any], frame: dict[str, Any], where: str, faults: Faults
) -> Intrinsics | None:
    """Read the lens of a frame; None and noted faults if it is not to be used."""
    noted_before = faults.noted
    numbers = _Numbers(content, frame, where, faults)
    model = frame.get("camera_model", content.get("camera_model", "OPENCV"))
    if model not in SUPPORTED_MODELS:
        names = ", ".join(SUPPORTED_MODELS)
        owner = where if "camera_model" in frame else "transforms.json"
        faults.add(
            owner,
            f"camera_model {describe(model)} is not supported; expected one of {names}: undistort first",
        )
    width, height = numbers.read_size("w"), numbers.read_size("h")
    focal_x, focal_y = numbers.read("fl_x"), numbers.read("fl_y")
    angle_x = numbers.read("camera_angle_x")
    _check_focal(focal_x, focal_y, angle_x, numbers, where, faults)
    bending = numbers.read_bending()
    if model in ("PINHOLE", "SIMPLE_PINHOLE") and any(bending.values()):
        faults.add(where, f"camera_model {model} comes with distortion {bending}; expected OPENCV or zeros")
    if faults.noted > noted_before:
        return None
    focal_px = None if focal_x is None else (focal_x, focal_x if focal_y is None else focal_y)
    return Intrinsics(
        width=width,
        height=height,
        focal_px=focal_px,
        angle_x=angle_x,
        center_px=(numbers.read("cx"), numbers.read("cy")),
        distortion=(bending["k1"], bending["k2"], bending["p1"], bending["p2"]),
        higher_radial=(bending["k3"], bending["k4"]),
    )


def _check_focal(
    focal_x: float | None,
    focal_y: float | None,
    angle_x: float | None,
    numbers: _Numbers,
    where: str,
    faults: Faults,
) -> None:
    for key, focal in (("fl_x", focal_x), ("fl_y", focal_y)):
        if focal is not None and not 1.0 / GREATEST_PX <= focal <= GREATEST_PX:
            faults.add(where, f"'{key}' is {focal:g}; expected a focal length above 0 in pixels")
    if angle_x is not None and not SMALLEST_ANGLE <= angle_x <= math.pi - SMALLEST_ANGLE:
        faults.add(where, f"'camera_angle_x' is {angle_x:g}; expected radians between 0 and pi")
    if not numbers.has("fl_x") and not numbers.has("camera_angle_x"):
        faults.add(
            where, "'fl_x' is absent; expected the focal length in pixels, for a frame or the whole scene"
        )


class _Numbers:
    """Numbers of a frame, or of the scene where the frame has none; each fault is noted where the number is."""

    def __init__(self, content: dict[str, Any], frame: dict[str, Any], where: str, faults: Faults) -> None:
        self._content, self._frame, self._where, self._faults = content, frame, where, faults

    def has(self, key: str) -> bool:
        return self._frame.get(key) is not None or self._content.get(key) is not None

    def read(self, key: str) -> float | None:
        source = self._frame if self._frame.get(key) is not None else self._content
        value = source.get(key)
        if value is None:
            return None
        number = read_number(value)
        if number is None or abs(number) > GREATEST_PX:
            where = self._where if source is self._frame else "transforms.json"
            self._faults.add(where, f"'{key}' is {describe(value)}; expected a finite number, at most 1e9")
            return None
        return number

    def read_size(self, key: str) -> int | None:
        number = self.read(key)
        if number is not None and (number < 1 or number != int(number)):
            self._faults.add(self._where, f"'{key}' is {number:g}; expected a whole number of pixels")
            return None
        return None if number is None else int(number)

    def read_bending(self) -> dict[str, float]:
        bending = {key: self.read(key) or 0.0 for key in BENDING_KEYS}
        listed = self._frame.get("distortion_params", self._content.get("distortion_params"))
        if listed is None:
            return bending
        values = [read_number(value) for value in listed] if isinstance(listed, list) else []
        if len(values) != len(BENDING_KEYS) or any(
            value is None or abs(value) > GREATEST_PX for value in values
        ):
            names = ", ".join(BENDING_KEYS)
            self._faults.add(
                self._where, f"'distortion_params' is {describe(listed)}; expected the numbers {names}"
            )
            return bending
        return {key: value or 0.0 for key, value in zip(BENDING_KEYS, values, strict=True)}
