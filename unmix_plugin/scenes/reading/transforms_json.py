"""transforms.json in nerfstudio's form with the keys of UnMix-NeRF: from text of unknown origin to typed entries.

Nothing here opens a file other than transforms.json; a value of the wrong type becomes a noted fault and None. Keys of
a frame come before those of the whole scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.placement import Placement, read_metres_per_unit, read_placement
from unmix_plugin.scenes.reading.faults import (
    Faults,
    UnreadableJsonError,
    describe,
    read_json_file,
    read_number,
)
from unmix_plugin.scenes.reading.foreign_keys import FILE_NAME, keys_to_say
from unmix_plugin.scenes.reading.lenses import Intrinsics, read_intrinsics
from unmix_plugin.spectral.bands import require_nanometres

Size = tuple[int, int]
"""Height and width in pixels."""
_FILE_KEYS = tuple(f"{key}_path" for key in ("file", "hyperspectral_file", "seg_file", "mask"))
_FILE_KEYS += ("abundance_file_path", "responses_path")
_SPLIT_KEYS = ("train_filenames", "val_filenames", "test_filenames")

_RIGID_TOLERANCE = 5e-3
"""Largest element of R^T R - 1 that passes as rounding of printed digits; the rotation nearest to R is then taken."""
_MAX_DISTANCE = 1e9
"""Camera positions beyond this are damage; squares of larger ones would leave float32."""
_ROW_POSES, _KEY_POSES = "row_poses", "key_poses"
_GREATEST_TURN_DEG = 90.0
"""Between neighbouring key poses: beyond, it is unclear which way the camera turned."""


def read_pose(
    matrix: Any, where: str, faults: Faults, name: str = "'transform_matrix'"
) -> Float64[np.ndarray, "3 4"] | None:
    """Check a `transform_matrix` (4x4 or 3x4, OpenGL camera to world); None and a noted fault if it is not a pose.

    Args:
        name: What messages call it.
    """
    rows = _read_rows(matrix)
    if rows is None:
        found = "is absent" if matrix is None else f"is {_found(matrix)}"
        faults.add(where, f"{name} {found}; expected 4 (or 3) rows of 4 finite numbers, camera to world")
        return None
    if len(rows) == 4 and np.abs(rows[3] - np.array([0.0, 0.0, 0.0, 1.0])).max() > 1e-6:
        last = ", ".join(f"{value:g}" for value in rows[3])
        faults.add(where, f"{name} is not rigid: its last row is ({last}); expected (0, 0, 0, 1)")
        return None
    rotation, position = rows[:3, :3], rows[:3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= _RIGID_TOLERANCE:
        lengths = ", ".join(f"{math.hypot(*axis):.4g}" for axis in rotation.T)  # hypot does not overflow
        message = f"{name} is not rigid: its axes have lengths ({lengths}) and R^T R is off the identity"
        faults.add(where, f"{message} by {deviation:.3g}; expected a rotation without scale or shear")
        return None
    if np.linalg.det(rotation) < 0.0:
        faults.add(where, f"{name} is a reflection (determinant -1); expected a rotation, flip one axis")
        return None
    if np.abs(position).max() > _MAX_DISTANCE:
        faults.add(where, f"{name} puts the camera at {position.tolist()}; expected less than 1e9 units away")
        return None
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, position[:, None]], axis=1)


def _read_rows(matrix: Any) -> Float64[np.ndarray, "rows 4"] | None:
    is_matrix = isinstance(matrix, list) and len(matrix) in (3, 4)
    if not is_matrix or not all(isinstance(row, list) and len(row) == 4 for row in matrix):
        return None
    numbers = [[read_number(value) for value in row] for row in matrix]
    return None if any(None in row for row in numbers) else np.array(numbers, dtype=np.float64)


def _found(matrix: Any) -> str:
    """What stands in place of rows of numbers: a value that is no number, or else the whole."""
    if isinstance(matrix, list):
        for number, row in enumerate(matrix):
            if not isinstance(row, list) or len(row) != 4:
                return f"{describe(matrix)} whose row {number} is {describe(row)}"
            for value in row:
                if read_number(value) is None:
                    return f"{describe(matrix)} rows with {describe(value)} in row {number}"
    return describe(matrix)


@dataclass(frozen=True)
class _LinePoses:
    """Checked poses of one line camera."""

    rows: Float64[np.ndarray, " n"]
    """Row of each pose, increasing."""
    poses: Float64[np.ndarray, "n 3 4"]
    """Camera to world, rotations orthonormal."""
    is_by_row: bool
    """Whether they were given row by row."""

    def middle(self, num_rows: int) -> Float64[np.ndarray, "3 4"]:
        """The pose halfway through an image of so many rows; key poses may reach beyond it."""
        keys = KeyPoses(torch.from_numpy(self.poses), torch.from_numpy(self.rows), (len(self.rows),))
        y = torch.tensor([0.5 * (num_rows - 1)], dtype=torch.float64)
        return keys.at(torch.zeros(1, dtype=torch.int64), y)[0].numpy()

    def fault(self, num_rows: int) -> str | None:
        """Why the poses don't fit an image of so many rows; None if they do."""
        if self.is_by_row:
            if len(self.rows) == num_rows:
                return None
            found = f"'{_ROW_POSES}' has {len(self.rows)} poses, but the image has {num_rows} rows"
            return f"{found}; expected one pose a row"
        first, last = float(self.rows[0]), float(self.rows[-1])
        if first <= 0 and last >= num_rows - 1:
            return None
        return (
            f"'{_KEY_POSES}' reach from row {first:g} to row {last:g}, but the image has rows 0 to {num_rows - 1}; "
            "expected the first key pose at row 0 or before it, and the last at the last row or after it"
        )


def read_line_poses(frame: dict[str, Any], where: str, faults: Faults) -> _LinePoses | None:
    """The poses of a line camera; None for a frame camera, and with a noted fault where they are wrong."""
    given = [key for key in (_ROW_POSES, _KEY_POSES) if frame.get(key) is not None]
    if not given:
        return None
    if len(given) == 2 or frame.get("transform_matrix") is not None:
        named = [*given, *(["transform_matrix"] if frame.get("transform_matrix") is not None else [])]
        faults.add(where, f"has {' and '.join(repr(key) for key in named)}; expected one of them")
        return None
    entries = frame[given[0]]
    if not isinstance(entries, list) or len(entries) < 2:
        faults.add(where, f"'{given[0]}' is {describe(entries)}; expected a list of at least two poses")
        return None
    rows, poses = [], []
    for index, entry in enumerate(entries):
        here, name, matrix, row = f"{where} '{given[0]}'[{index}]", "the pose", entry, float(index)
        if given[0] == _KEY_POSES:
            keys = entry if isinstance(entry, dict) else {}
            name, matrix = "'transform_matrix'", keys.get("transform_matrix")
            if (number := read_number(keys.get("row"))) is None:
                found = f"has the row {describe(keys.get('row'))}" if keys else f"is {describe(entry)}"
                faults.add(here, f"{found}; expected an object with 'row' (a number) and 'transform_matrix'")
                return None
            row = number
        pose = read_pose(matrix, here, faults, name)
        if pose is None:  # one is enough: a list of a thousand rows has them all wrong in one way
            return None
        if rows and row <= rows[-1]:
            faults.add(where, f"the rows of '{_KEY_POSES}' must increase; got {rows[-1]:g} then {row:g}")
            return None
        rows.append(row)
        poses.append(pose)
    stacked = np.stack(poses)
    products = np.einsum("nab,nab->n", stacked[1:, :, :3], stacked[:-1, :, :3])
    turns = np.rad2deg(np.arccos(np.clip((products - 1) / 2, -1, 1)))
    largest = int(turns.argmax())
    if turns[largest] > _GREATEST_TURN_DEG:
        turn = f"the camera turns by {turns[largest]:.0f} degrees from row {rows[largest]:g} to row"
        most = f"expected at most {_GREATEST_TURN_DEG:g}, give more key poses"
        faults.add(where, f"{turn} {rows[largest + 1]:g}; {most}")
        return None
    return _LinePoses(np.array(rows), stacked, given[0] == _ROW_POSES)


@dataclass(frozen=True)
class SensorEntry:
    """What a frame says of its sensor; None where it says nothing."""

    name: str | None = None
    bands: tuple[int, ...] | None = None
    """Bands of the scene, one a channel, in the order of the channels."""


def read_sensor_entry(frame: dict[str, Any], where: str, faults: Faults) -> SensorEntry:
    """The keys `sensor` and `bands` of a frame; whether the bands exist is asked later."""
    name, bands = frame.get("sensor"), frame.get("bands")
    if name is not None and (not isinstance(name, str) or not name.strip()):
        faults.add(where, f"'sensor' is {describe(name)}; expected a name")
        name = None
    if bands is None:
        return SensorEntry(name)
    if frame.get("responses_path") is not None:
        faults.add(where, "has 'bands' and 'responses_path'; a sensor has one of them, drop the other")
    if not isinstance(bands, list) or not bands or not all(type(band) is int for band in bands):
        faults.add(where, f"'bands' is {describe(bands)}; expected indices into 'wavelengths', one a channel")
        return SensorEntry(name)
    repeated = sorted({band for band in bands if bands.count(band) > 1})
    if repeated:
        faults.add(where, f"'bands' repeats {', '.join(map(str, repeated))}; expected each band once")
    return SensorEntry(name, tuple(bands))


@dataclass(frozen=True)
class FrameEntry:
    """One element of `frames`; None where a value is absent or faulty."""

    where: str
    """How messages call it."""
    paths: dict[str, str]
    """The values of `_FILE_KEYS` that are there."""
    pose: Float64[np.ndarray, "3 4"] | None
    """Camera to world, rotation orthonormal; of a line camera halfway through its image, None before `at_sizes`."""
    intrinsics: Intrinsics | None
    """Lens of this frame."""
    sensor: SensorEntry = SensorEntry()
    """What it was taken with."""
    line_poses: _LinePoses | None = None
    """Poses by row, where it was taken by a line camera."""
    shot: str | None = None
    """Name of the shot; the lenses of a rig take one together."""

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
    metres_per_unit: float | None = None
    """Metres in a unit of the world that the poses come from."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Widths of the instrument's bands, NaN where one is unknown."""
    warnings: tuple[str, ...] = ()
    """Keys that stand for something and are not followed, or that nobody knows."""


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
    said = keys_to_say(content, [frame for frame in frames if isinstance(frame, dict)])
    return SceneEntry(
        warnings=tuple(f"{FILE_NAME}: {text}" for texts in said for text in texts),
        wavelengths_nm=_read_wavelengths(content, faults, needs_cubes),
        materials=_read_materials(content, faults),
        illuminant_path=_read_text(content, "illuminant_path", FILE_NAME, faults),
        endmembers_path=_read_text(content, "endmembers_path", FILE_NAME, faults),
        value_scale=read_value_scale(content, faults),
        fwhm_nm=read_widths(content, faults),
        split_lists=_read_split_lists(content, faults),
        frames=tuple(_read_frame(content, frame, i, faults, needs_cubes) for i, frame in enumerate(frames)),
        placement=read_placement(content, faults, FILE_NAME),
        metres_per_unit=read_metres_per_unit(content, faults, FILE_NAME),
    )


def _read_object(path: Path, faults: Faults) -> dict[str, Any]:
    if not path.parent.is_dir():
        found = "is a file, not a scene folder" if path.parent.is_file() else "the scene folder is not there"
        faults.add(str(path.parent), f"{found}; give the folder that holds transforms.json with --data")
    elif not path.is_file():
        faults.add(FILE_NAME, "is not in the scene folder; expected nerfstudio's form (see the README)")
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
        faults.add(FILE_NAME, f"holds {describe(content)}; expected an object with 'frames'")
        faults.raise_if_any()
    return content


def _read_frame(
    content: dict[str, Any], frame: Any, index: int, faults: Faults, needs_cube: bool
) -> FrameEntry:
    where = f"frames[{index}]"
    if not isinstance(frame, dict):
        faults.add(where, f"is {describe(frame)}; expected an object")
        return FrameEntry(where, {}, None, None)
    paths = {key: _read_text(frame, key, where, faults) for key in _FILE_KEYS}
    if needs_cube and frame.get("hyperspectral_file_path") is None:
        faults.add(where, "has no 'hyperspectral_file_path'; expected the path of its (H, W, B) .npy cube")
    if frame.get("hyperspectral_file_path") is None and frame.get("file_path") is None and not needs_cube:
        faults.add(where, "has no 'file_path'; expected the path of its picture")
    noted = faults.noted
    lines = read_line_poses(frame, where, faults)
    is_frame_camera = lines is None and faults.noted == noted
    pose = read_pose(frame.get("transform_matrix"), where, faults) if is_frame_camera else None
    lens, sensor = read_intrinsics(content, frame, where, faults), read_sensor_entry(frame, where, faults)
    named = {key: path for key, path in paths.items() if path is not None}
    shot = frame["capture"] if isinstance(frame.get("capture"), str) else None
    return FrameEntry(where, named, pose, lens, sensor, lines, shot)


def at_sizes(entry: SceneEntry, sizes: Sequence[Size], faults: Faults) -> SceneEntry:
    """The entry with one pose for each line camera, too; notes a fault where poses of lines don't fit the image.

    Args:
        sizes: Of each frame's image.
    """
    frames = []
    for frame, (num_rows, _) in zip(entry.frames, sizes, strict=True):
        if frame.line_poses is not None:
            if (fault := frame.line_poses.fault(num_rows)) is not None:
                faults.add(frame.where, fault)
            frame = replace(frame, pose=frame.line_poses.middle(num_rows))
        frames.append(frame)
    return replace(entry, frames=tuple(frames))


def _read_text(content: dict[str, Any], key: str, where: str, faults: Faults) -> str | None:
    value = content.get(key)
    if value is None:
        return None
    if not isinstance(value, str) or not value or any(character < " " for character in value):
        faults.add(where, f"'{key}' is {describe(value)}; expected a path")
        return None
    return value.replace("\\", "/")


def read_widths(content: dict[str, Any], faults: Faults) -> Float64[np.ndarray, " B"] | None:
    """The key `fwhm`, NaN where a width is unknown; None if it is absent, and with a noted fault if it is wrong."""
    values, centers = content.get("fwhm"), content.get("wavelengths")
    if values is None or not isinstance(centers, list):
        return None
    values = [0.0 if value is None else value for value in values] if isinstance(values, list) else []
    numbers = [number for value in values if (number := read_number(value)) is not None and number >= 0]
    if len(numbers) != len(centers) or len(values) != len(centers):
        expected = "a width in nm above 0 for each of the wavelengths (0 or null where it is unknown)"
        faults.add(FILE_NAME, f"'fwhm' must have {expected}, or be left out")
        return None
    return np.array([number or np.nan for number in numbers])


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
            found = f"'wavelengths' has {describe(values[band])} at band {band}"
            faults.add(FILE_NAME, f"{found}; expected a positive number in nm")
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


def read_value_scale(content: dict[str, Any], faults: Faults) -> float | None:
    """The stored number that stands for 1; None if it is absent, and with a noted fault if it is wrong."""
    value = content.get("value_scale")
    scale = read_number(value)
    if value is not None and (scale is None or not 1e-30 <= scale <= 1e30):
        faults.add(FILE_NAME, f"'value_scale' is {describe(value)}; expected what stands for 1, above 0")
        return None
    return scale


def _read_materials(content: dict[str, Any], faults: Faults) -> tuple[str, ...] | None:
    values = content.get("materials")
    if values is None:
        return None
    names = values if isinstance(values, list) else [None]
    are_names = names and all(isinstance(v, str) and v.strip() and v.isprintable() for v in names)
    if not are_names or len(set(values)) != len(values):
        faults.add(FILE_NAME, f"'materials' is {describe(values)}; expected a list of different names")
        return None
    return tuple(values)


def _read_split_lists(content: dict[str, Any], faults: Faults) -> dict[str, tuple[str, ...]]:
    lists: dict[str, tuple[str, ...]] = {}
    for key in _SPLIT_KEYS:
        values = content.get(key)
        if values is None:
            continue
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            faults.add(FILE_NAME, f"'{key}' is {describe(values)}; expected a list of file paths")
            continue
        lists[key.removesuffix("_filenames")] = tuple(value.replace("\\", "/") for value in values)
    return lists
