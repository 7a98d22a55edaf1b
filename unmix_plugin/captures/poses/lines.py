"""Poses of line cameras, one a line, from tables: of a track (a row a line, or a row a moment), or of stages (a row a
scan: where the camera stood at its first line, and how a linear or a rotation stage went on).

Which kind a table is shows in its columns. Positions are those of the camera, in a world in which what is looked at
stands still; +z is up.

Notation: `H` lines of a scan.
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
from unmix_plugin.captures.poses.line_stages import scans_of_stages
from unmix_plugin.captures.poses.line_tables import MOST_TURN_RAD, ScanTable, TableRow, read_scan_table
from unmix_plugin.captures.poses.line_tracks import scans_of_track
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

_Lines = Float64[np.ndarray, "H 3 4"]


def read_line_poses(views: Sequence[CaptureView], root: Path, options: ProcessOptions) -> PoseSet:
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
        is_track = any(name in table.columns for name in _OF_TRACKS)
        scans = _by_scan(table, views, owner, notes)
        read = scans_of_track(table, scans, options) if is_track else scans_of_stages(scans, options)
        for name, lines in read.items():
            _require_movement(lines, name, table.path)
            found[name] = lines.copy()
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
