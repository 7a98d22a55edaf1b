"""Which sensor took a frame: its bands or responses in transforms.json, and frames grouped by sensor.

Notation: `B` bands of the scene, `b` channels of a frame's cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.transforms_json import FrameEntry, Size
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import SceneSensor, read_sensor


def read_operators(
    frames: Sequence[FrameEntry], wavelengths_nm: Float64[np.ndarray, " B"] | None, faults: Faults
) -> list[Float64[np.ndarray, "_ _"] | None]:
    """The operator of each frame, as `SceneSensor.matrix`; None where it can't be told, as without wavelengths."""
    if wavelengths_nm is None:
        return [None] * len(frames)
    tables: dict[Path, Float64[np.ndarray, "_ _"] | None] = {}
    operators: list[Float64[np.ndarray, "_ _"] | None] = []
    for frame in frames:
        path = frame.files.get("responses_path")
        if path is not None:
            if path not in tables:
                tables[path] = _read_responses(path, Bands(wavelengths_nm), frame.where, faults)
            operators.append(tables[path])
            continue
        rows, last = np.eye(len(wavelengths_nm)), len(wavelengths_nm) - 1
        chosen = range(last + 1) if frame.sensor.bands is None else frame.sensor.bands
        outside = [band for band in chosen if not 0 <= band <= last]
        if outside:
            expected = f"expected 0 to {last}, indices into 'wavelengths'"
            faults.add(frame.where, f"'bands' has {outside[0]}; {expected}")
        operators.append(None if outside else rows[list(chosen)])
    return operators


def group_by_sensor(
    frames: Sequence[FrameEntry],
    operators: Sequence[Float64[np.ndarray, "_ _"]],
    sizes: Sequence[Size],
    faults: Faults,
) -> tuple[tuple[SceneSensor, ...], tuple[int, ...]]:
    """The sensors in the order in which they appear, and the index of each frame's.

    Frames without a name are of one sensor if their bands and sizes are the same.
    """
    known: dict[str | tuple[bytes, Size], tuple[int, Size]] = {}
    sensors: list[SceneSensor] = []
    indices = []
    for frame, matrix, size in zip(frames, operators, sizes, strict=True):
        name = frame.sensor.name
        key = (matrix.tobytes(), size) if name is None else name
        if key not in known:
            known[key] = (len(sensors), size)
            sensors.append(SceneSensor(name or _new_name(matrix, size, sensors), matrix))
        index, first_size = known[key]
        if first_size != size:
            found, expected = (f"{wide} x {high}" for high, wide in (size, first_size))
            faults.add(
                frame.where, f"has {found} pixels, others of sensor {name!r} {expected}; name it otherwise"
            )
        elif not np.array_equal(sensors[index].matrix, matrix):
            faults.add(frame.where, f"has other bands than others of sensor {name!r}; name it otherwise")
        indices.append(index)
    return tuple(sensors), tuple(indices)


def unseen_bands(
    sensors: tuple[SceneSensor, ...], train_sensors: set[int], wavelengths_nm: Float64[np.ndarray, " B"]
) -> str | None:
    """A fault of bands of the scene that no training frame sees: nothing could be learnt of them."""
    seen = np.any([sensors[index].seen_bands for index in sorted(train_sensors)], axis=0)
    missing = ", ".join(f"{nm:g}" for nm in wavelengths_nm[~seen])
    return f"no training frame sees the bands at {missing} nm; leave them out" if missing else None


def lonely_sensors(sensors: tuple[SceneSensor, ...], train_sensors: set[int]) -> list[str]:
    """Names of sensors of the training frames whose bands no other sensor of them sees."""
    used = [sensors[index] for index in sorted(train_sensors)]
    is_shared = np.sum([sensor.seen_bands for sensor in used], axis=0) > 1
    return [sensor.name for sensor in used if len(used) > 1 and not (sensor.seen_bands & is_shared).any()]


def _read_responses(
    path: Path, bands: Bands, where: str, faults: Faults
) -> Float64[np.ndarray, "_ _"] | None:
    """Channels in the order of the table's columns; one that reaches beyond the bands is a fault."""
    try:
        sensor = read_sensor(path)
        seen = sensor.seen_by(bands)
    except SpectrumError as error:
        return faults.add(where, str(error))
    if seen.notes:
        found = "; ".join(seen.notes)
        return faults.add(where, f"{path}: {found}; 'wavelengths' must cover all channels")
    columns = [seen.names.index(name) for name in sensor.column_names]
    return np.ascontiguousarray(seen.matrix.T[columns])


def _new_name(matrix: Float64[np.ndarray, "_ _"], size: Size, sensors: list[SceneSensor]) -> str:
    """Such as `12-bands-24x24`, with a number behind it where another sensor has that name."""
    name = f"{len(matrix)}-band{'s' * (len(matrix) > 1)}-{size[1]}x{size[0]}"
    candidates = [name, *(f"{name}-{number}" for number in range(2, len(sensors) + 3))]
    return next(each for each in candidates if each not in {sensor.name for sensor in sensors})
