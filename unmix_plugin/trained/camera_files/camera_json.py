"""What all camera files have in common: JSON of unknown origin to checked cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.scenes.reading.faults import (
    Faults,
    UnreadableJsonError,
    describe,
    read_json_file,
    read_number,
)
from unmix_plugin.scenes.reading.transforms_json import read_pose
from unmix_plugin.trained.run_views import RunView

FORMAT_VERSION = 1
"""Of the camera files that we write."""

GREATEST_SIDE_PX = 16_384
"""Width and height of the largest picture."""

_GREATEST_FPS = 1000


@dataclass(frozen=True)
class CameraFile:
    """What a camera file says."""

    views: tuple[RunView, ...]
    """At least one; all of one size, in model space, with different names fit for file names."""
    frames_per_second: float | None
    """Where the cameras are a path; None where they are single views."""


def check_size(width: float | int, height: float | int, where: str) -> tuple[int, int]:
    """Width and height of a picture in pixels: whole numbers from 1 to `GREATEST_SIDE_PX`, or a ConfigError."""
    if not all(side == int(side) and 1 <= side <= GREATEST_SIDE_PX for side in (width, height)):
        raise ConfigError(
            f"{where}: {width:g} x {height:g} pixels; expected whole numbers from 1 to {GREATEST_SIDE_PX}"
        )
    return int(width), int(height)


def check_frames_per_second(value: float | int | None, where: str) -> float:
    """Frames a second of a video: above 0 and at most 1000, or a ConfigError."""
    if value is None or not 0 < value <= _GREATEST_FPS:
        raise ConfigError(
            f"{where}: {value} frames a second; expected a number above 0, at most {_GREATEST_FPS}"
        )
    return float(value)


def read_camera_json(path: Path) -> dict[str, Any]:
    """The object in a camera file.

    Raises:
        ConfigError: the file is missing, empty, no JSON object, or of another version.
    """
    try:
        content = read_json_file(path)
    except OSError as error:
        raise ConfigError(f"can't read the camera file {path}: {error.strerror or error}") from error
    except UnreadableJsonError as error:
        raise ConfigError(f"{path} {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} holds {describe(content)}; expected an object with cameras")
    version = content.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        raise ConfigError(
            f"{path} has format_version {describe(version)}; this version reads {FORMAT_VERSION}: update this package "
            "or write the file again"
        )
    return content


def one_view(
    name: str,
    pose: Float64[np.ndarray, "3 4"],
    focal_px: Sequence[float],
    center_px: Sequence[float],
    distortion: Sequence[float],
    size: tuple[int, int],
) -> RunView:
    """A view of one camera, model space; sizes and lengths in pixels, `size` is width and height."""
    width, height = size
    matrix, focal, center, bending = (
        torch.tensor(np.array([values]), dtype=torch.float32)
        for values in (pose, focal_px, center_px, distortion)
    )
    return RunView(name, Cameras(matrix, focal, center, bending, width, height))


def camera_entries(content: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    """The objects in a list, one a camera; a ConfigError for anything else, and for an empty list."""
    entries = content[key]
    if not isinstance(entries, list):
        raise ConfigError(f"{path}: '{key}' is {describe(entries)}; expected a list with one object a camera")
    if not entries:
        raise ConfigError(f"{path}: '{key}' is empty; expected at least one camera")
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise ConfigError(f"{path}: {key}[{index}] is {describe(entry)}; expected an object")
    return entries


def needed_number(values: dict[str, Any], key: str, where: Path | str) -> float:
    """A finite number; a ConfigError where it is absent or no number."""
    number = read_number(values.get(key))
    if number is None:
        found = describe(values[key]) if key in values else "absent"
        raise ConfigError(f"{where}: '{key}' is {found}; expected a number")
    return number


def needed_pose(matrix: Any, where: str, path: Path, key: str) -> Float64[np.ndarray, "3 4"]:
    """Camera to world, its rotation orthonormal.

    Args:
        matrix: 4 (or 3) rows of 4 numbers.
        where, path, key: Camera, file and key of the matrix, for messages.
    Raises:
        ConfigError: no matrix, or not rigid.
    """
    faults = Faults(path)
    pose = read_pose(matrix, where, faults)
    try:
        faults.raise_if_any()
    except SceneError as error:
        raise ConfigError(str(error).replace("'transform_matrix'", f"'{key}'")) from error
    assert pose is not None
    return pose
