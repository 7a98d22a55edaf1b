"""transforms.json in nerfstudio's form with the keys of UnMix-NeRF: from text of unknown origin to typed entries.

Nothing here opens a file other than transforms.json; a value of the wrong type becomes a noted fault and None. Keys of
a frame come before those of the whole scene.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.errors import SceneError, SpectrumError
from unmix_plugin.scenes.placement import Placement, read_metres_per_unit, read_placement
from unmix_plugin.scenes.reading.faults import (
    Faults,
    UnreadableJsonError,
    describe,
    read_json_file,
    read_number,
    read_numbers,
    read_within,
)
from unmix_plugin.scenes.reading.foreign_keys import FILE_NAME, keys_to_say
from unmix_plugin.scenes.reading.lenses import Intrinsics, read_intrinsics
from unmix_plugin.spectral.bands import require_nanometres

Size = tuple[int, int]
"""Height and width in pixels."""
CUBE_KEY = "hyperspectral_file_path"
_FILE_KEYS = tuple(
    f"{what}_path"
    for what in ("file", "hyperspectral_file", "seg_file", "mask", "abundance_file", "responses")
)

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
    rows = read_numbers(matrix, 4, 4)
    rows = read_numbers(matrix, 3, 4) if rows is None else rows
    if rows is None:
        found = "is absent" if matrix is None else f"is {_found(matrix)}"
        return faults.add(
            where, f"{name} {found}; expected 4 (or 3) rows of 4 finite numbers, camera to world"
        )
    if len(rows) == 4 and np.abs(rows[3] - (0, 0, 0, 1)).max() > 1e-6:
        last = ", ".join(f"{value:g}" for value in rows[3])
        return faults.add(where, f"{name} is not rigid: its last row is ({last}); expected (0, 0, 0, 1)")
    rotation, position = rows[:3, :3], rows[:3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= _RIGID_TOLERANCE:
        lengths = ", ".join(f"{math.hypot(*axis):.4g}" for axis in rotation.T)  # hypot does not overflow
        message = f"{name} is not rigid: its axes have lengths ({lengths}) and R^T R is off the identity"
        return faults.add(where, f"{message} by {deviation:.3g}; expected a rotation without scale or shear")
    if np.linalg.det(rotation) < 0.0:
        return faults.add(
            where, f"{name} is a reflection (determinant -1); expected a rotation, flip one axis"
        )
    if np.abs(position).max() > _MAX_DISTANCE:
        found = f"puts the camera at {position.tolist()}"
        return faults.add(where, f"{name} {found}; expected less than 1e9 units away")
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, position[:, None]], axis=1)


def _found(matrix: Any) -> str:
    """What stands in place of rows of numbers: a value that is no number, or else the whole."""
    for number, row in enumerate(matrix if isinstance(matrix, list) else []):
        is_row = isinstance(row, list) and len(row) == 4
        wrong = [value for value in row if read_number(value) is None] if is_row else [row]
        if wrong:
            return f"{describe(matrix)} with {describe(wrong[0])} in row {number}"
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
        first, last = float(self.rows[0]), float(self.rows[-1])
        if self.is_by_row and len(self.rows) != num_rows:
            found = f"'{_ROW_POSES}' has {len(self.rows)} poses, but the image has {num_rows} rows"
            return f"{found}; expected one pose a row"
        if first > 0 or last < num_rows - 1:
            found = f"'{_KEY_POSES}' reach from row {first:g} to row {last:g}"
            return f"{found}, but the image has rows 0 to {num_rows - 1}; expected key poses at both ends or beyond"
        return None


def read_line_poses(frame: dict[str, Any], where: str, faults: Faults) -> _LinePoses | None:
    """The poses of a line camera; None for a frame camera, and with a noted fault where they are wrong."""
    given = [key for key in (_ROW_POSES, _KEY_POSES, "transform_matrix") if frame.get(key) is not None]
    if given in ([], ["transform_matrix"]):
        return None
    if len(given) > 1:
        return faults.add(where, f"has {' and '.join(repr(key) for key in given)}; expected one of them")
    [key] = given
    entries = frame[key]
    if not isinstance(entries, list) or len(entries) < 2:
        return faults.add(where, f"'{key}' is {describe(entries)}; expected a list of at least two poses")
    rows, poses = [], []
    for index, entry in enumerate(entries):
        row, pose = _read_line_pose(entry, index, key == _KEY_POSES, f"{where} '{key}'[{index}]", faults)
        if (
            row is None or pose is None
        ):  # one is enough: a list of a thousand rows has them all wrong in one way
            return None
        if rows and row <= rows[-1]:
            return faults.add(where, f"the rows of '{key}' must increase; got {rows[-1]:g} then {row:g}")
        rows.append(row)
        poses.append(pose)
    stacked = np.stack(poses)
    products = np.einsum("nab,nab->n", stacked[1:, :, :3], stacked[:-1, :, :3])
    turns = np.rad2deg(np.arccos(np.clip((products - 1) / 2, -1, 1)))
    largest = int(turns.argmax())
    if turns[largest] > _GREATEST_TURN_DEG:
        found = f"the camera turns by {turns[largest]:.0f} degrees from row {rows[largest]:g} to row"
        most = f"expected at most {_GREATEST_TURN_DEG:g}, give more key poses"
        return faults.add(where, f"{found} {rows[largest + 1]:g}; {most}")
    return _LinePoses(np.array(rows), stacked, key == _ROW_POSES)


def _read_line_pose(
    entry: Any, index: int, is_key_pose: bool, where: str, faults: Faults
) -> tuple[float | None, Float64[np.ndarray, "3 4"] | None]:
    """Row and pose; None with a noted fault where one is wrong."""
    if not is_key_pose:
        return float(index), read_pose(entry, where, faults, "the pose")
    keys = entry if isinstance(entry, dict) else {}
    row = read_number(keys.get("row"))
    if row is None:
        found = f"has the row {describe(keys.get('row'))}" if keys else f"is {describe(entry)}"
        faults.add(where, f"{found}; expected an object with 'row' (a number) and 'transform_matrix'")
        return None, None
    return row, read_pose(keys.get("transform_matrix"), where, faults)


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
    files: Mapping[str, Path] = field(default_factory=dict)
    """Where `paths` lead, as far as they were followed."""

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
    reflectance_of_1: float | None = None
    """Reflectance that 1 stands for, where values are reflectances that were divided by it; in the light of the scene a
    white is 1 over it."""
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
        raise SceneError(f"{root}: {FILE_NAME}: 'frames' {found}; expected a list with one object a view")
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
        reflectance_of_1=read_within(
            content, "reflectance_of_1", 1e-30, 1e30, "a reflectance, above 0", FILE_NAME, faults
        ),
        fwhm_nm=read_widths(content, faults),
        split_lists=read_split_lists(content, faults),
        frames=tuple(_read_frame(content, frame, i, faults, needs_cubes) for i, frame in enumerate(frames)),
        placement=read_placement(content, faults, FILE_NAME),
        metres_per_unit=read_metres_per_unit(content, faults, FILE_NAME),
    )


def _read_object(path: Path, faults: Faults) -> dict[str, Any]:
    content: Any = None
    if not path.parent.is_dir():
        found = "is a file, not a scene folder" if path.parent.is_file() else "the scene folder is not there"
        faults.add(str(path.parent), f"{found}; give the folder that holds transforms.json with --data")
    elif not path.is_file():
        faults.add(FILE_NAME, "is not in the scene folder; unmix-process makes a scene of raw files")
    else:
        try:
            content = read_json_file(path)
            if not isinstance(content, dict):
                faults.add(FILE_NAME, f"holds {describe(content)}; expected an object with 'frames'")
        except OSError as error:
            faults.add(FILE_NAME, f"cannot be read ({error.strerror})")
        except UnreadableJsonError as error:
            faults.add(FILE_NAME, str(error))
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
    if needs_cube and frame.get(CUBE_KEY) is None:
        faults.add(where, f"has no '{CUBE_KEY}'; expected the path of its (H, W, B) .npy cube")
    elif frame.get(CUBE_KEY) is None and frame.get("file_path") is None:
        faults.add(where, "has no 'file_path'; expected the path of its picture")
    noted = faults.noted
    lines = read_line_poses(frame, where, faults)
    is_frame_camera = lines is None and faults.noted == noted
    return FrameEntry(
        where,
        {key: path for key, path in paths.items() if path is not None},
        read_pose(frame.get("transform_matrix"), where, faults) if is_frame_camera else None,
        read_intrinsics(content, frame, where, faults),
        read_sensor_entry(frame, where, faults),
        lines,
        frame["capture"] if isinstance(frame.get("capture"), str) else None,
    )


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
        return faults.add(where, f"'{key}' is {describe(value)}; expected a path")
    return value.replace("\\", "/")


def read_widths(content: dict[str, Any], faults: Faults) -> Float64[np.ndarray, " B"] | None:
    """The key `fwhm`, NaN where a width is unknown; None if it is absent, and with a noted fault if it is wrong."""
    values, centers = content.get("fwhm"), content.get("wavelengths")
    if values is None or not isinstance(centers, list):
        return None
    known = [0.0 if value is None else value for value in values] if isinstance(values, list) else None
    widths = read_numbers(known, len(centers))
    if widths is None or (widths < 0).any():
        expected = "a width in nm above 0 for each of the wavelengths (0 or null where it is unknown)"
        return faults.add(FILE_NAME, f"'fwhm' must have {expected}, or be left out")
    return np.where(widths == 0, np.nan, widths)


def _read_wavelengths(
    content: dict[str, Any], faults: Faults, is_needed: bool
) -> Float64[np.ndarray, " B"] | None:
    values = content.get("wavelengths")
    if values is None and not is_needed:
        return None
    if not isinstance(values, list) or not values:
        found = "is absent" if values is None else f"is {describe(values)}"
        return faults.add(FILE_NAME, f"'wavelengths' {found}; expected a list of the bands' centres in nm")
    numbers = [read_number(value) or -1.0 for value in values]
    if min(numbers) <= 0:
        band = next(band for band, number in enumerate(numbers) if number <= 0)
        found = f"'wavelengths' has {describe(values[band])} at band {band}"
        return faults.add(FILE_NAME, f"{found}; expected a positive number in nm")
    wavelengths = np.array(numbers, dtype=np.float64)
    drops = np.flatnonzero(np.diff(wavelengths) <= 0.0)
    if drops.size:
        a, b = wavelengths[drops[0]], wavelengths[drops[0] + 1]
        message = f"'wavelengths' must increase; got {a:g} nm then {b:g} nm at band {drops[0] + 1}"
        return faults.add(FILE_NAME, message + "; sort the bands of wavelengths and cubes alike")
    try:
        require_nanometres(wavelengths)
    except SpectrumError as error:
        return faults.add(FILE_NAME, f"'wavelengths': {error}")
    return wavelengths


def read_value_scale(content: dict[str, Any], faults: Faults) -> float | None:
    """The stored number that stands for 1; None if it is absent, and with a noted fault if it is wrong."""
    return read_within(content, "value_scale", 1e-30, 1e30, "what stands for 1, above 0", FILE_NAME, faults)


def _read_materials(content: dict[str, Any], faults: Faults) -> tuple[str, ...] | None:
    values = content.get("materials")
    if values is None:
        return None
    names = values if isinstance(values, list) else [None]
    are_names = names and all(isinstance(v, str) and v.strip() and v.isprintable() for v in names)
    if not are_names or len(set(values)) != len(values):
        return faults.add(FILE_NAME, f"'materials' is {describe(values)}; expected a list of different names")
    return tuple(values)


def read_split_lists(content: dict[str, Any], faults: Faults) -> dict[str, tuple[str, ...]]:
    """Paths of `train`, `val` and `test`, where there are lists of them; with a noted fault where one is wrong."""
    lists: dict[str, tuple[str, ...]] = {}
    for name in ("train", "val", "test"):
        values = content.get(f"{name}_filenames")
        if isinstance(values, list) and all(isinstance(value, str) for value in values):
            lists[name] = tuple(value.replace("\\", "/") for value in values)
        elif values is not None:
            faults.add(FILE_NAME, f"'{name}_filenames' is {describe(values)}; expected a list of file paths")
    return lists
