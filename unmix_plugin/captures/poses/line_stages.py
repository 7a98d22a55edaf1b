"""Tables of stages: a row a scan, with where the camera stood at its first line and what the stage did.

A linear stage has a direction and a step a line or a speed, a rotation stage an axis, a point on it and a turn a line
or a spin. The camera stands as a rotation says, or so that its line lies across the movement.

Notation: `H` lines of a scan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses import line_motion
from unmix_plugin.captures.poses.line_tables import (
    AXIS,
    CENTRE,
    DIRECTION,
    LOOK,
    MATRIX,
    MOST_TURN_RAD,
    PLACE,
    QUATERNION,
    TableRow,
    line_rate,
)
from unmix_plugin.errors import CaptureError

_Lines = Float64[np.ndarray, "H 3 4"]


def scans_of_stages(
    scans: Sequence[tuple[CaptureView, list[TableRow]]], options: ProcessOptions
) -> dict[str, _Lines]:
    """Poses of the lines of each scan by its row. Raises CaptureError: it has several, or one that is wrong."""
    found = {}
    for view, rows in scans:
        if len(rows) > 1:
            raise CaptureError(
                f"{rows[1].where}: a second row for scan {view.name}; expected one, or a column 'line' or 'time' in a "
                "table with the pose of each line"
            )
        found[view.name] = _staged(rows[0], view, options)
    return found


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
