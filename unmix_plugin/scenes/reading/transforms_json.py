"""transforms.json in nerfstudio's form with the keys of UnMix-NeRF: from text of unknown origin to typed entries.

Nothing here opens a file other than transforms.json; a value of the wrong type becomes a noted fault and None.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.placement import Placement, read_placement
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.intrinsics import Intrinsics, read_intrinsics
from unmix_plugin.scenes.reading.json_values import UnreadableJsonError, describe, read_json_file, read_number
from unmix_plugin.scenes.reading.line_poses import LinePoses, read_line_poses
from unmix_plugin.scenes.reading.poses import read_pose
from unmix_plugin.scenes.reading.sensors import SensorEntry, read_sensor_entry
from unmix_plugin.spectral.bands import require_nanometres

FILE_NAME = "transforms.json"
SPLIT_KEYS = ("train_filenames", "val_filenames", "test_filenames")
FILE_KEYS = (
    "file_path",
    "hyperspectral_file_path",
    "seg_file_path",
    "mask_path",
    "abundance_file_path",
    "responses_path",
)


@dataclass(frozen=True)
class FrameEntry:
    """One element of `frames`; None where a value is absent or faulty."""

    where: str
    """How messages call it."""
    paths: dict[str, str]
    """The values of `FILE_KEYS` that are there."""
    pose: Float64[np.ndarray, "3 4"] | None
    """Camera to world, rotation orthonormal; of a line camera in the middle of its image."""
    intrinsics: Intrinsics | None
    """Lens of this frame."""
    sensor: SensorEntry = SensorEntry()
    """What it was taken with."""
    line_poses: LinePoses | None = None
    """Poses by row, where it was taken by a line camera."""

    def name_of(self, key: str) -> str:
        """One of its files, for messages."""
        return f"{self.where} {self.paths[key]}" if key in self.paths else self.where


@dataclass(frozen=True)
class SceneEntry:
    """The content of transforms.json; None where a value is absent or faulty."""

    wavelengths_nm: Float64[np.ndarray, " B"] | None
    materials: tuple[str, ...] | None
    illuminant_path: str | None
    endmembers_path: str | None
    split_lists: dict[str, tuple[str, ...]]
    frames: tuple[FrameEntry, ...]
    placement: Placement = field(default_factory=Placement)
    """How the poses were moved from where they come from."""
    value_scale: float | None = None
    """What cubes are divided by, where the options don't say."""


def read_transforms(root: Path, faults: Faults, needs_cubes: bool = True) -> SceneEntry:
    """Read transforms.json, noting every fault in it.

    Args:
        root: Folder that holds it.
        faults: Where faults are noted.
        needs_cubes: Whether frames must have cubes of spectra, and the scene wavelengths; without, pictures will do.
    Raises:
        SceneError: the file is absent, is no JSON object, or has no list of frames: there is nothing to go on with.
    """
    content = _read_object(root / FILE_NAME, faults)
    frames = content.get("frames")
    if not isinstance(frames, list):
        found = "is absent" if frames is None else f"is {describe(frames)}"
        faults.add(FILE_NAME, f"'frames' {found}; expected a list with one object a view")
        faults.raise_if_any()
    frames = frames if isinstance(frames, list) else []
    if not frames:
        faults.add(FILE_NAME, "'frames' is empty; a scene needs frames to train on and to evaluate")
    return SceneEntry(
        wavelengths_nm=_read_wavelengths(content, faults, needs_cubes),
        materials=_read_materials(content, faults),
        illuminant_path=_read_text(content, "illuminant_path", FILE_NAME, faults),
        endmembers_path=_read_text(content, "endmembers_path", FILE_NAME, faults),
        value_scale=_read_value_scale(content, faults),
        split_lists=_read_split_lists(content, faults),
        frames=tuple(_read_frame(content, frame, i, faults, needs_cubes) for i, frame in enumerate(frames)),
        placement=read_placement(content, faults, FILE_NAME),
    )


def _read_object(path: Path, faults: Faults) -> dict[str, Any]:
    if not path.parent.is_dir():
        found = "is a file, not a scene folder" if path.parent.is_file() else "the scene folder is not there"
        faults.add(str(path.parent), f"{found}; give the folder that holds transforms.json with --data")
    elif not path.is_file():
        faults.add(
            FILE_NAME, "is not in the scene folder; expected nerfstudio's form (see the README, 'own data')"
        )
    faults.raise_if_any()
    content: Any = None
    try:
        content = read_json_file(path)
    except OSError as error:
        faults.add(FILE_NAME, f"cannot be read ({error.strerror})")
    except UnreadableJsonError as error:
        faults.add(FILE_NAME, str(error))
    faults.raise_if_any()
    if not isinstance(content, dict):
        faults.add(
            FILE_NAME, f"holds {describe(content)}; expected an object with 'frames' and 'wavelengths'"
        )
        faults.raise_if_any()
    return content


def _read_frame(
    content: dict[str, Any], frame: Any, index: int, faults: Faults, needs_cube: bool
) -> FrameEntry:
    where = f"frames[{index}]"
    if not isinstance(frame, dict):
        faults.add(where, f"is {describe(frame)}; expected an object")
        return FrameEntry(where, {}, None, None)
    paths = {key: _read_text(frame, key, where, faults) for key in FILE_KEYS}
    if needs_cube and frame.get("hyperspectral_file_path") is None:
        faults.add(where, "has no 'hyperspectral_file_path'; expected the path of its (H, W, B) .npy cube")
    if frame.get("hyperspectral_file_path") is None and frame.get("file_path") is None and not needs_cube:
        faults.add(where, "has no 'file_path'; expected the path of its picture")
    noted = faults.noted
    lines = read_line_poses(frame, where, faults)
    is_frame_camera = lines is None and faults.noted == noted
    pose = read_pose(frame.get("transform_matrix"), where, faults) if is_frame_camera else None
    return FrameEntry(
        where=where,
        paths={key: path for key, path in paths.items() if path is not None},
        pose=pose if lines is None else lines.middle,
        intrinsics=read_intrinsics(content, frame, where, faults),
        sensor=read_sensor_entry(frame, where, faults),
        line_poses=lines,
    )


def _read_text(content: dict[str, Any], key: str, where: str, faults: Faults) -> str | None:
    value = content.get(key)
    if value is None:
        return None
    if not isinstance(value, str) or not value or any(character < " " for character in value):
        faults.add(where, f"'{key}' is {describe(value)}; expected a path")
        return None
    return value


def _read_wavelengths(
    content: dict[str, Any], faults: Faults, is_needed: bool
) -> Float64[np.ndarray, " B"] | None:
    values = content.get("wavelengths")
    if values is None and not is_needed:
        return None
    if values is None:
        faults.add(FILE_NAME, "'wavelengths' is absent; expected a list with the centre of each band in nm")
        return None
    if not isinstance(values, list) or not values:
        faults.add(FILE_NAME, f"'wavelengths' is {describe(values)}; expected a list of numbers in nm")
        return None
    numbers = [read_number(value) for value in values]
    for band, number in enumerate(numbers):
        if number is None or number <= 0.0:
            found = describe(values[band])
            faults.add(
                FILE_NAME, f"'wavelengths' has {found} at band {band}; expected a positive number in nm"
            )
            return None
    wavelengths = np.array(numbers, dtype=np.float64)
    drops = np.flatnonzero(np.diff(wavelengths) <= 0.0)
    if drops.size:
        a, b = wavelengths[drops[0]], wavelengths[drops[0] + 1]
        message = f"'wavelengths' must increase; got {a:g} nm then {b:g} nm at band {drops[0] + 1}"
        faults.add(FILE_NAME, message + "; sort the bands of wavelengths and cubes alike")
        return None
    try:
        require_nanometres(wavelengths)
    except SpectrumError as error:
        faults.add(FILE_NAME, f"'wavelengths': {error}")
        return None
    return wavelengths


def _read_value_scale(content: dict[str, Any], faults: Faults) -> float | None:
    value = content.get("value_scale")
    scale = read_number(value)
    if value is not None and (scale is None or not 1e-30 <= scale <= 1e30):
        faults.add(
            FILE_NAME, f"'value_scale' is {describe(value)}; expected a positive number, what stands for 1"
        )
        return None
    return scale


def _read_materials(content: dict[str, Any], faults: Faults) -> tuple[str, ...] | None:
    values = content.get("materials")
    if values is None:
        return None
    is_list = isinstance(values, list) and values and all(isinstance(v, str) and v.strip() for v in values)
    if not is_list or len(set(values)) != len(values):
        faults.add(FILE_NAME, f"'materials' is {describe(values)}; expected a list of different names")
        return None
    return tuple(values)


def _read_split_lists(content: dict[str, Any], faults: Faults) -> dict[str, tuple[str, ...]]:
    lists: dict[str, tuple[str, ...]] = {}
    for key in SPLIT_KEYS:
        values = content.get(key)
        if values is None:
            continue
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            faults.add(FILE_NAME, f"'{key}' is {describe(values)}; expected a list of file paths")
            continue
        lists[key.removesuffix("_filenames")] = tuple(values)
    return lists
