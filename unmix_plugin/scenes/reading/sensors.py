"""Which sensor took a frame: its bands or responses in transforms.json, and frames grouped by sensor.

Notation: `B` bands of the scene, `b` channels of a frame's cube.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.transforms_json import SensorEntry, Size
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.sensor import SceneSensor, read_sensor


def read_operators(
    entries: list[tuple[str, SensorEntry, Path | None]],
    wavelengths_nm: Float64[np.ndarray, " B"] | None,
    faults: Faults,
) -> list[Float64[np.ndarray, "_ _"] | None]:
    """The operator of each frame, as `SceneSensor.matrix`; None where it can't be told.

    Args:
        entries: For each frame how messages call it, its entry and its table of responses.
        wavelengths_nm: Of the scene; None where they are faulty.
    """
    if wavelengths_nm is None:
        return [None] * len(entries)
    tables: dict[Path, Float64[np.ndarray, "_ _"] | None] = {}
    operators: list[Float64[np.ndarray, "_ _"] | None] = []
    for where, entry, path in entries:
        if path is not None:
            if path not in tables:
                tables[path] = _read_responses(path, Bands(wavelengths_nm), where, faults)
            operators.append(tables[path])
        else:
            rows, last = np.eye(len(wavelengths_nm)), len(wavelengths_nm) - 1
            chosen = tuple(range(len(rows))) if entry.bands is None else entry.bands
            outside = next((band for band in chosen if not 0 <= band <= last), None)
            if outside is not None:
                message = f"'bands' has {outside}; expected 0 to {last}, indices into 'wavelengths'"
                faults.add(where, message)
            operators.append(rows[list(chosen)] if outside is None else None)
    return operators


def group_by_sensor(
    entries: list[tuple[str, SensorEntry, Path | None]],
    operators: list[Float64[np.ndarray, "_ _"]],
    sizes: list[Size],
    faults: Faults,
) -> tuple[tuple[SceneSensor, ...], tuple[int, ...]]:
    """The sensors in the order in which they appear, and the index of each frame's.

    Frames without a name are of one sensor if their bands and sizes are the same.
    """
    known: dict[str | tuple[bytes, Size], tuple[int, bytes, Size]] = {}
    sensors: list[SceneSensor] = []
    indices = []
    for (where, entry, _), matrix, size in zip(entries, operators, sizes, strict=True):
        key = (matrix.tobytes(), size) if entry.name is None else entry.name
        if key not in known:
            known[key] = (len(sensors), matrix.tobytes(), size)
            sensors.append(SceneSensor(entry.name or _new_name(matrix, size, sensors), matrix))
        index, first_matrix, first_size = known[key]
        if first_size != size:
            found, expected = (f"{wide} x {high}" for high, wide in (size, first_size))
            others = f"others of sensor {entry.name!r} {expected}"
            faults.add(where, f"has {found} pixels, {others}; name it otherwise")
        elif first_matrix != matrix.tobytes():
            faults.add(where, f"has other bands than others of sensor {entry.name!r}; name it otherwise")
        indices.append(index)
    return tuple(sensors), tuple(indices)


def check_coverage(
    sensors: tuple[SceneSensor, ...],
    train_sensors: set[int],
    wavelengths_nm: Float64[np.ndarray, " B"],
    faults: Faults,
) -> None:
    """Refuse bands of the scene that no training frame sees: nothing could be learnt of them."""
    seen = np.any([sensors[index].seen_bands for index in sorted(train_sensors)], axis=0)
    if not seen.all():
        missing = ", ".join(f"{nm:g}" for nm in wavelengths_nm[~seen])
        faults.add("'wavelengths'", f"no training frame sees the bands at {missing} nm; leave them out")


def lonely_sensors(sensors: tuple[SceneSensor, ...], train_sensors: set[int]) -> list[str]:
    """Names of sensors of the training frames whose bands no other sensor of them sees."""
    used = sorted(train_sensors)
    counts = np.sum([sensors[index].seen_bands for index in used], axis=0)
    alone = [not (sensors[index].seen_bands & (counts > 1)).any() for index in used]
    return [
        sensors[index].name for index, is_alone in zip(used, alone, strict=True) if is_alone and len(used) > 1
    ]


def _read_responses(
    path: Path, bands: Bands, where: str, faults: Faults
) -> Float64[np.ndarray, "_ _"] | None:
    """Channels in the order of the table's columns; one that reaches beyond the bands is a fault."""
    try:
        sensor = read_sensor(path)
        seen = sensor.seen_by(bands)
    except SpectrumError as error:
        faults.add(where, str(error))
        return None
    if seen.notes:
        faults.add(where, f"{path}: " + "; ".join(seen.notes) + "; 'wavelengths' must cover all channels")
        return None
    columns = [seen.names.index(name) for name in sensor.column_names]
    return np.ascontiguousarray(seen.matrix.T[columns])


def _new_name(matrix: Float64[np.ndarray, "_ _"], size: Size, sensors: list[SceneSensor]) -> str:
    """Such as `12-bands-24x24`, with a number behind it where another sensor has that name."""
    name = f"{len(matrix)}-band{'s' * (len(matrix) > 1)}-{size[1]}x{size[0]}"
    names = {sensor.name for sensor in sensors}
    return next(n for n in (name, *(f"{name}-{i}" for i in range(2, len(sensors) + 3))) if n not in names)
