"""Poses of line cameras, one a line, from tables: of a track (a row a line, or a row a moment), or of stages (a row a
scan: where the camera stood at its first line, and how a linear or a rotation stage went on).

Which kind a table is shows in its columns. Positions are those of the camera, in a world in which what is looked at
stands still; +z is up.

A linear stage has a direction and a step a line or a speed, a rotation stage an axis, a point on it and a turn a line
or a spin. The camera stands as a rotation says, or so that its line lies across the movement.

Notation: `H` lines of a scan, `n` rows of its table.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses import line_motion
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.line_tables import (
    AXIS,
    CENTRE,
    DIRECTION,
    LOOK,
    MATRIX,
    MOST_TURN_RAD,
    OF_STAGES,
    PLACE,
    QUATERNION,
    ScanTable,
    TableRow,
    line_rate,
    read_scan_table,
)
from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, find_offset
from unmix_plugin.engine.geometry.camera_paths import nearest_to_axes
from unmix_plugin.errors import CaptureError, ConfigError, did_you_mean, name_some

_TABLE_NAME = "poses.csv"
"""Looked for in the capture's folder where none is named."""
_OF_TRACKS = ("line", "time")
_LARGEST_JUMP = 30.0
"""Of a line's movement over the usual one: more is a slip of the table, or of the stage."""
_ANGLES_DEG = (0.01, 170.0)
_LEAST_LINES = 2
_WIDEST_GAP = 10.0
"""Between neighbouring rows of a track, over the usual distance in time: more is a gap."""

_Lines = Float64[np.ndarray, "H 3 4"]


def line_table_poses(views: Sequence[CaptureView], root: Path, options: ProcessOptions) -> PoseSet:
    """The poses of all scans that tables tell, with the lens that the options say.

    Args:
        views: Scans, whose lines run along the first axis of their cubes.
        root: Folder of the capture, in which tables are looked for, too.
    Raises:
        CaptureError: a table is not there, is damaged, or does not fit its scan.
        ConfigError: an option is missing or wrong.
    """
    angle = options.field_of_view
    if angle is None or not _ANGLES_DEG[0] <= angle <= _ANGLES_DEG[1]:
        raise ConfigError(
            f"--field-of-view {'is not given' if angle is None else f'is {angle:g}'}; expected the degrees that a line "
            f"of the camera spans, from its first column to its last, {_ANGLES_DEG[0]:g} to {_ANGLES_DEG[1]:g}"
        )
    for view in views:
        if view.cube.shape[0] < _LEAST_LINES:
            raise CaptureError(f"{view.cube.path} has 1 line; a scan has {_LEAST_LINES} or more")
    tables, notes = _tables(views, root, options.poses)
    found: dict[str, _Lines] = {}
    for table, owner in tables:
        scans = _by_scan(table, views, owner, notes)
        is_track = any(name in table.columns for name in _OF_TRACKS)
        if is_track:
            table.refuse_columns(OF_STAGES, "is one of stages, while the table has poses of lines")
        if {*_OF_TRACKS} <= {*table.columns}:
            table.refuse_columns(("time",), "says again what 'line' says")
        for view, rows in scans:
            if not is_track and len(rows) > 1:
                raise CaptureError(
                    f"{rows[1].where}: a second row for scan {view.name}; expected one, or a column 'line' or 'time' "
                    "in a table with the pose of each line"
                )
            if is_track:
                poses = np.stack([row.pose(options.camera_axes) for row in rows])
                by_line = "line" in table.columns
                lines = (
                    poses[_order_of_lines(table, view, rows)]
                    if by_line
                    else _timed(table, view, rows, poses, options)
                )
            else:
                lines = _staged(rows[0], view, options)
            _require_movement(lines, view.name, table.path)
            found[view.name] = lines.copy()
    units = {table.metres_per_unit for table, _ in tables}
    if len(units) > 1:
        paths = name_some([table.path.name for table, _ in tables])
        raise CaptureError(
            f"{paths}: lengths have a unit in one table and none in another; name it in all, or in none"
        )
    offset = find_offset(np.concatenate([lines[:, :, 3] for lines in found.values()]))
    cameras = {}
    for view in views:
        if view.name in found:
            lines = found[view.name]
            lines[:, :, 3] -= offset
            height, width, _ = view.cube.shape
            focal = 0.5 * width / math.tan(math.radians(angle) / 2)
            lens = Lens(width, height, (focal, focal), (width / 2, height / 2))
            cameras[view.name] = PosedCamera(line_motion.middle_of(lines), lens, lines=lines)
    listed = name_some([table.path.name for table, _ in tables])
    return PoseSet(
        cameras,
        f"poses of lines in {listed}",
        offset=offset,
        up=np.array([0.0, 0.0, 1.0]),
        metres_per_unit=units.pop(),
        notes=tuple(notes),
        warnings=(*_jumps(found), *_looking_away(list(found.values()))),
    )


def _tables(
    views: Sequence[CaptureView], root: Path, where: str | None
) -> tuple[list[tuple[ScanTable, CaptureView | None]], list[str]]:
    """One table of all scans, or a table a scan with the scan that it is of; and an empty list for notes."""
    path = root / _TABLE_NAME if where is None else Path(where)
    if not path.exists() and where is not None:
        path = root / where
    if path.is_dir():
        files = [(path / f"{view.name}.csv", view) for view in views]
        there = [(read_scan_table(file), view) for file, view in files if file.is_file()]
        if not there:
            raise CaptureError(
                f"{path} has no table of a scan; expected such as {files[0][0].name}, one a scan"
            )
        return list(there), []
    if not path.is_file():
        raise CaptureError(
            f"{path} is not there; give a table with the poses of lines, or of the stage, with --poses, as a file with "
            "a column 'scan' or a folder with NAME.csv for each scan"
        )
    return [(read_scan_table(path), None)], []


def _by_scan(
    table: ScanTable, views: Sequence[CaptureView], owner: CaptureView | None, notes: list[str]
) -> list[tuple[CaptureView, list[TableRow]]]:
    """The rows of each scan. Raises CaptureError: the table does not say whose they are, or names no scan of these."""
    if owner is None and len(views) == 1 and "scan" not in table.columns:
        owner = views[0]
    if owner is not None and "scan" not in table.columns:
        return [(owner, list(table.rows))]
    if "scan" not in table.columns:
        raise CaptureError(
            f"{table.path} has no column 'scan', while there are {len(views)} scans; add the names of the scans"
        )
    names: dict[str, CaptureView] = {}
    for view in views:
        for name in (view.name, view.cube.path.name, view.cube.path.stem):
            names.setdefault(name.casefold(), view)
    rows: dict[str, list[TableRow]] = defaultdict(list)
    for row in table.rows:
        rows[row.words.get("scan", "")].append(row)
    found = [(names[name.casefold()], own) for name, own in rows.items() if name.casefold() in names]
    unknown = [name or "(empty)" for name in rows if name.casefold() not in names]
    if not found:
        hint = did_you_mean(unknown[0], [view.name for view in views], form="; {}")
        raise CaptureError(
            f"{table.path} names the scans {name_some(unknown)}, there are {name_some([v.name for v in views])}{hint}"
        )
    if unknown:
        notes.append(f"scans of {table.path.name} that are not there: {name_some(unknown)}")
    return found


# Tracks: the poses of lines, a row each, or poses at moments, which are interpolated at the times of lines.


def _order_of_lines(table: ScanTable, view: CaptureView, rows: Sequence[TableRow]) -> list[int]:
    """Which row each line of the image has. Raises CaptureError: lines are missing, there twice, or too many."""
    numbers = [row.cells.get("line", math.nan) for row in rows]
    where, height = f"{table.path}, scan {view.name}", view.cube.shape[0]
    odd = [row.where for row, number in zip(rows, numbers, strict=True) if not number.is_integer()]
    if odd:
        raise CaptureError(f"{odd[0]}: line is no whole number; expected 0, 1, 2, ...")
    owners: dict[int, int] = {}
    for index, number in enumerate(numbers):
        if owners.setdefault(int(number), index) != index:
            raise CaptureError(f"{where}: line {int(number)} is there twice; expected each once")
    if 0 not in owners and len(owners) == max(owners) >= height:  # counted from 1
        owners = {number - 1: index for number, index in owners.items()}
    missing = [number for number in range(height) if number not in owners]
    last = height + view.cube.dark_lines - 1
    beyond = [number for number in sorted(owners) if not 0 <= number <= last]
    if missing or beyond:
        found = f"lacks {_ranges(missing)}" if missing else f"has {_ranges(beyond)}"
        raise CaptureError(f"{where} {found}; expected lines 0 to {height - 1}, one row each")
    return [owners[number] for number in range(height)]


def _ranges(numbers: Sequence[int]) -> str:
    """Lines in words.

    >>> _ranges([3, 4, 5, 9])
    'lines 3 to 5, 9'
    """
    starts = [number for number in numbers if number - 1 not in numbers]
    ends = [number for number in numbers if number + 1 not in numbers]
    parts = [f"{a}" if a == b else f"{a} to {b}" for a, b in zip(starts, ends, strict=True)]
    return f"line{'s' * (len(numbers) > 1)} {name_some(parts)}"


def _timed(
    table: ScanTable,
    view: CaptureView,
    rows: Sequence[TableRow],
    poses: Float64[np.ndarray, "n 3 4"],
    options: ProcessOptions,
) -> _Lines:
    """Poses at the times of lines. Where there are as many rows as lines, each is that of a line."""
    where, height = f"{table.path}, scan {view.name}", view.cube.shape[0]
    times = np.array([row.cells.get("time", math.nan) for row in rows])
    steps = np.diff(times)
    if not np.isfinite(times).all() or not (steps > 0).all():
        first = int(np.flatnonzero(~(np.append(steps > 0.0, np.isfinite(times[-1]))))[0])
        raise CaptureError(f"{rows[first].where}: times must rise from row to row, and none may be empty")
    if len(rows) in (height, height + view.cube.dark_lines):
        return poses[:height]
    if len(rows) < 2:
        raise CaptureError(f"{where} has 1 row; expected 2 or more")
    wide = int(steps.argmax())
    if steps[wide] > _WIDEST_GAP * np.median(steps):
        raise CaptureError(
            f"{where} has no pose between {times[wide]:g} and {times[wide + 1]:g} s, while rows usually are "
            f"{np.median(steps):.3g} s apart; scan again, or cut the scan there"
        )
    rate = line_rate(view, None, options, f"{where}: times of lines")
    end = (height - 1) / rate
    if times[0] > 1e-9 or times[-1] < end * (1 - 1e-9):
        raise CaptureError(
            f"{where} has times from {times[0]:g} to {times[-1]:g} s; the {height} lines take 0 to {end:g} s at "
            f"{rate:g} a second: count time from the first line on, and name another unit, such as time (ms)"
        )
    return line_motion.at_times(times, poses, np.minimum(np.arange(height) / rate, times[-1]))


# Stages: a row a scan, with where the camera stood at its first line and what the stage did.


def _staged(row: TableRow, view: CaptureView, options: ProcessOptions) -> _Lines:
    """Poses of a scan on the stage that a row describes."""
    direction, axis, centre = (row.vector(names) for names in (DIRECTION, AXIS, CENTRE))
    if (direction is None) == (axis is None):
        found = "neither a direction nor an axis" if axis is None else "a direction and an axis"
        raise CaptureError(
            f"{row.where} has {found}; expected {DIRECTION[0]}, _y, _z of a linear stage, or {AXIS[0]}, _y, _z of a "
            "rotation stage"
        )
    moves = row.words.get("moves", "").lower()
    if moves not in ("camera", "object"):
        found = f"is {moves!r}" if moves else "is missing"
        raise CaptureError(
            f"{row.where}: moves {found}; expected 'camera' or 'object', whichever the stage carries"
        )
    for name, vector in (("direction", direction), ("axis", axis)):
        if vector is not None and not np.linalg.norm(vector) > 0:
            raise CaptureError(f"{row.where}: {name} is 0, 0, 0; expected where it points")
    sign = 1.0 if moves == "camera" else -1.0
    height = view.cube.shape[0]
    if direction is not None:
        step = sign * _amount_a_line(row, ("step", "speed"), ("turn", "spin"), view, options)
        way = direction / np.linalg.norm(direction) * step
        return line_motion.moved_along(_first_pose(row, way, options), way, height)
    assert axis is not None
    if centre is None:
        raise CaptureError(
            f"{row.where} has no {CENTRE[0]}, _y, _z; expected a point on the axis of the stage"
        )
    place, look = row.vector(PLACE), row.vector(LOOK)
    turn = sign * _amount_a_line(row, ("turn", "spin"), ("step", "speed"), view, options)
    if abs(turn) > MOST_TURN_RAD:
        raise CaptureError(
            f"{row.where}: the stage turns by {math.degrees(abs(turn)):.3g} degrees from line to line; expected "
            f"at most {math.degrees(MOST_TURN_RAD):g}: are these degrees a second (spin)?"
        )
    way = np.zeros(3)
    if place is not None and look is not None:
        way = line_motion.sweep_about(place, look, axis * math.copysign(1.0, turn), centre)
    return line_motion.turned_about(_first_pose(row, way, options), axis, centre, turn, height)


def _amount_a_line(
    row: TableRow, names: tuple[str, str], others: tuple[str, str], view: CaptureView, options: ProcessOptions
) -> float:
    """How far a stage goes from line to line, by a column a line or one a second."""
    if wrong := [name for name in others if name in row.cells]:
        kind = "linear" if names[0] == "step" else "rotation"
        raise CaptureError(f"{row.where}: a {kind} stage has no {wrong[0]}; expected {' or '.join(names)}")
    a_line, a_second = (row.cells.get(name) for name in names)
    if (a_line is None) == (a_second is None):
        raise CaptureError(
            f"{row.where} has {'no' if a_line is None else 'both'} {' and '.join(names)}; expected one"
        )
    amount = a_line if a_line is not None else 0.0
    if a_second is not None:
        amount = a_second / line_rate(view, row, options, f"{row.where}: {names[1]}: movements a second")
    if amount == 0.0:
        raise CaptureError(
            f"{row.where}: the stage does not move; expected a {' or a '.join(names)} other than 0"
        )
    return amount


def _first_pose(
    row: TableRow, way: Float64[np.ndarray, "3"], options: ProcessOptions
) -> Float64[np.ndarray, "3 4"]:
    """The pose of a scan's first line: by a rotation, or by where the camera looks and the way it goes."""
    place, look = row.vector(PLACE), row.vector(LOOK)
    if look is None:
        return row.pose(options.camera_axes)
    if place is None or row.vector(QUATERNION) is not None or row.vector(MATRIX) is not None:
        raise CaptureError(
            f"{row.where} has {LOOK[0]} beside a rotation, or no x, y, z; expected one of both"
        )
    if not np.linalg.norm(look) > 0:
        raise CaptureError(f"{row.where}: look is 0, 0, 0; expected where the camera looks")
    pose = line_motion.looking(place, look, way, math.degrees(row.cells.get("roll", 0.0)))
    if pose is None:
        raise CaptureError(
            f"{row.where}: the camera looks along its own movement, so that lines would not leave each other; expected "
            "the direction of the stage across the view"
        )
    return pose


# What looks wrong in poses of all kinds.


def _require_movement(lines: _Lines, name: str, path: Path) -> None:
    """Refuse a camera that stands still or turns too far between lines. Raises CaptureError."""
    if not np.ptp(lines, axis=0).any():
        raise CaptureError(
            f"{path}: all {len(lines)} lines of {name} have one pose; expected a camera that moves"
        )
    products = np.einsum("nab,nab->n", lines[1:, :, :3], lines[:-1, :, :3])
    turns = np.arccos(np.clip((products - 1) / 2, -1, 1))
    if turns.max() > MOST_TURN_RAD + 1e-9:
        line = int(turns.argmax())
        raise CaptureError(
            f"{path}, scan {name}: the camera turns by {math.degrees(turns[line]):.0f} degrees from line {line} to "
            f"{line + 1}; expected at most {math.degrees(MOST_TURN_RAD):g}"
        )


def _jumps(found: Mapping[str, _Lines]) -> list[str]:
    """Lines that lie far off their neighbours."""
    warnings = []
    for name, lines in found.items():
        steps = np.linalg.norm(np.diff(lines[:, :, 3], axis=0), axis=1)
        line, usual = int(steps.argmax()), float(np.median(steps))
        if usual > 0 and steps[line] > _LARGEST_JUMP * usual:
            warnings.append(
                f"scan {name}: the camera jumps from line {line} to {line + 1}, by {steps[line] / usual:.0f} times the "
                "usual way: look at these rows of the table"
            )
    return warnings


def _looking_away(scans: Sequence[_Lines]) -> list[str]:
    """Whether cameras look away from where their views meet, as axes of another convention do."""
    middles = np.stack([line_motion.middle_of(lines) for lines in scans])
    point = nearest_to_axes(middles)
    depths = ((point - middles[:, :, 3]) * -middles[:, :, 2]).sum(axis=1)
    spread = np.linalg.norm(middles[:, :, 2] - middles[:, :, 2].mean(axis=0), axis=1).max()
    reach = np.ptp(middles[:, :, 3], axis=0).max()
    if len(scans) < 2 or spread < 0.1 or np.median(depths) > -0.1 * reach:
        return []
    axes = "rotations may have OpenCV's axes (--camera-axes opencv), or look is turned round"
    return [f"most cameras look away from the place that their views have in common: {axes}"]
