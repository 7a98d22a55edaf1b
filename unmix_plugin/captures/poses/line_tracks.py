"""Tables of tracks: the poses of lines, a row each, or poses at moments, which are interpolated at the times of lines.

Notation: `H` lines of a scan, `n` rows of the table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses import line_motion
from unmix_plugin.captures.poses.line_tables import OF_STAGES, ScanTable, TableRow, line_rate
from unmix_plugin.errors import CaptureError, name_some

_WIDEST_GAP = 10.0
"""Between neighbouring rows of a track, over the usual distance in time: more is a gap."""
_Lines = Float64[np.ndarray, "H 3 4"]


def scans_of_track(
    table: ScanTable, scans: Sequence[tuple[CaptureView, list[TableRow]]], options: ProcessOptions
) -> dict[str, _Lines]:
    """Poses of the lines of each scan by its rows. Raises CaptureError: they do not fit the scan."""
    table.refuse_columns(OF_STAGES, "is one of stages, while the table has poses of lines")
    if "line" in table.columns and "time" in table.columns:
        table.refuse_columns(("time",), "says again what 'line' says")
    found = {}
    for view, rows in scans:
        poses = np.stack([row.pose(options.camera_axes) for row in rows])
        if "line" in table.columns:
            found[view.name] = poses[_order_of_lines(table, view, rows)]
        else:
            found[view.name] = _timed(table, view, rows, poses, options)
    return found


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
