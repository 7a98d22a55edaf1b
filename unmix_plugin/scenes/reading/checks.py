"""The files of a scene's frames, read and checked one frame at a time, and which sensor took each frame.

Notation: `B` bands of the scene, `b` channels of a frame's cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.folder import CUBE_KEY
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.cubes import check_abundances, check_cubes, warn_of_scale
from unmix_plugin.scenes.reading.entries import FrameEntry, Shape
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.images import check_colours, check_labels, check_masks
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import SceneSensor, read_sensor

_Pixels = Bool[np.ndarray, "_ _"]
_Operator = Float64[np.ndarray, "_ _"]


@dataclass(frozen=True)
class CheckedFrame:
    """What the checks found of a frame."""

    cube: Path
    sha256: str
    """Of the cube."""
    size: Shape
    """Of its pictures."""
    sensor: int
    """Which of the sensors took it."""
    unknown: _Pixels | None
    """Pixels that are not valid or masked out; None without."""
    foreground: _Pixels | None
    """Pixels that may show something: not fully transparent, or unknown; None where the scene has no alpha."""


@dataclass(frozen=True)
class CheckedFiles:
    """All frames, at least one, and what they have in common."""

    frames: tuple[CheckedFrame, ...]
    sensors: tuple[SceneSensor, ...]
    warnings: tuple[str, ...]

    @property
    def has_alpha(self) -> bool:
        """Whether some pixel of a picture is not opaque."""
        return self.frames[0].foreground is not None

    @property
    def sizes(self) -> list[Shape]:
        """Of each frame's pictures."""
        return [frame.size for frame in self.frames]


def check_frames(
    frames: Sequence[FrameEntry],
    wavelengths_nm: Float64[np.ndarray, " B"] | None,
    num_materials: int | None,
    options: SceneOptions,
    faults: Faults,
) -> CheckedFiles | None:
    """Read and check all files of all frames; None with noted faults if a cube or a sensor is not sound."""
    operators = _read_operators(frames, wavelengths_nm, faults)
    sizes, values = check_cubes(frames, operators, options, faults)
    shown, masks = check_colours(frames, sizes, faults), check_masks(frames, sizes, faults)
    check_labels(frames, sizes, num_materials, faults)
    check_abundances(frames, sizes, num_materials, faults)
    cubes = [cube for cube in values if cube is not None]
    known_sizes = [size for size in sizes if size is not None]
    known_operators = [operator for operator in operators if operator is not None]
    if not cubes or len(cubes) < len(frames) or len(known_operators) < len(frames):
        return None
    sensors, indices = _group_by_sensor(frames, known_operators, known_sizes, faults)
    checked = []
    for index, (frame, cube, mask, size) in enumerate(zip(frames, cubes, masks, known_sizes, strict=True)):
        unknown = _union(cube.invalid, None if mask is None else ~mask)
        has_valid = cube.num_invalid_pixels < cube.num_pixels
        if has_valid and mask is not None and mask.any() and unknown is not None and unknown.all():
            faults.note(cube.where, Message.MASK_LEAVES_NOTHING)
        foreground = None
        if shown is not None:
            seen = shown[index]
            foreground = _union(np.ones(size, bool) if seen is None else seen, unknown)
        checked.append(
            CheckedFrame(
                cube=frame.files[CUBE_KEY],
                sha256=cube.sha256,
                size=size,
                sensor=indices[index],
                unknown=unknown,
                foreground=foreground,
            )
        )
    return CheckedFiles(tuple(checked), sensors, warn_of_scale(cubes, options.value_scale))


def _union(one: _Pixels | None, other: _Pixels | None) -> _Pixels | None:
    """Pixels of either set; None is the empty one."""
    if one is None or other is None:
        return other if one is None else one
    return one | other


def _read_operators(
    frames: Sequence[FrameEntry], wavelengths_nm: Float64[np.ndarray, " B"] | None, faults: Faults
) -> list[_Operator | None]:
    """The operator of each frame, as `SceneSensor.matrix`; None where it is unknown, as without wavelengths."""
    if wavelengths_nm is None:
        return [None] * len(frames)
    tables: dict[Path, _Operator | None] = {}
    operators: list[_Operator | None] = []
    for frame in frames:
        path = frame.files.get("responses_path")
        if path is not None:
            if path not in tables:
                tables[path] = _read_responses(path, Bands(wavelengths_nm), frame.where, faults)
            operators.append(tables[path])
            continue
        rows, last = np.eye(len(wavelengths_nm)), len(wavelengths_nm) - 1
        chosen = range(last + 1) if frame.bands is None else frame.bands
        outside = [band for band in chosen if not 0 <= band <= last]
        if outside:
            faults.note(frame.where, Message.BAND_OUTSIDE, band=outside[0], last=last)
        operators.append(None if outside else rows[list(chosen)])
    return operators


def _read_responses(path: Path, bands: Bands, where: str, faults: Faults) -> _Operator | None:
    """Channels in the order of the table's columns; one that reaches beyond the bands is a fault."""
    try:
        sensor = read_sensor(path)
        seen = sensor.seen_by(bands)
    except SpectrumError as error:
        return faults.note(where, Message.WRONG_RESPONSES, reason=error)
    if seen.notes:
        return faults.note(where, Message.RESPONSES_UNCOVERED, path=path, reason="; ".join(seen.notes))
    columns = [seen.names.index(name) for name in sensor.column_names]
    return np.ascontiguousarray(seen.matrix.T[columns])


def _group_by_sensor(
    frames: Sequence[FrameEntry], operators: Sequence[_Operator], sizes: Sequence[Shape], faults: Faults
) -> tuple[tuple[SceneSensor, ...], tuple[int, ...]]:
    """The sensors in the order in which they appear, and the index of each frame's.

    Frames without a name are of one sensor if their bands and sizes are the same, which is called such as
    `12-bands-24x24`, with a number behind it where another has that name.
    """
    known: dict[str | tuple[bytes, Shape], tuple[int, Shape]] = {}
    sensors: list[SceneSensor] = []
    indices = []
    for frame, matrix, size in zip(frames, operators, sizes, strict=True):
        name = frame.sensor
        key = (matrix.tobytes(), size) if name is None else name
        if key not in known:
            known[key] = (len(sensors), size)
            usual = f"{len(matrix)}-band{'s' * (len(matrix) > 1)}-{size[1]}x{size[0]}"
            candidates = [usual, *(f"{usual}-{number}" for number in range(2, len(sensors) + 3))]
            free = [each for each in candidates if each not in {sensor.name for sensor in sensors}]
            sensors.append(SceneSensor(name or free[0], matrix))
        index, first_size = known[key]
        if first_size != size:
            found, expected = (f"{wide} x {high}" for high, wide in (size, first_size))
            values = {"found": found, "expected": expected, "sensor": name}
            faults.note(frame.where, Message.SENSOR_OF_OTHER_SIZE, **values)
        elif not np.array_equal(sensors[index].matrix, matrix):
            faults.note(frame.where, Message.SENSOR_OF_OTHER_BANDS, sensor=name)
        indices.append(index)
    return tuple(sensors), tuple(indices)
