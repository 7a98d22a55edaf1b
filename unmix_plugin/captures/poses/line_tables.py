"""Tables of scans as people write them: the poses of lines, or a row a scan with what its stage did.

A head names each column with its unit, `x (mm)`, `x [mm]` or `x_mm`; both kinds of table share this reader. Lengths
have a unit in all columns or in none, and are metres then. What can't be right names its line.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.poses.pose_set import FLIP, read_table
from unmix_plugin.engine.tables import Dialect, decode_text, possible_dialects, text_lines
from unmix_plugin.errors import CaptureError, did_you_mean, name_some

_METRES = {"km": 1e3, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
_RADIANS = {"deg": math.pi / 180, "degrees": math.pi / 180, "°": math.pi / 180, "rad": 1.0}
_A_SECOND = {"/s": 1.0, "/sec": 1.0, "/min": 1.0 / 60.0}

PLACE = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
LOOK, DIRECTION, AXIS, CENTRE = (
    tuple(f"{name}_{axis}" for axis in PLACE) for name in ("look", "direction", "axis", "centre")
)
OF_STAGES = (*DIRECTION, *AXIS, *CENTRE, *LOOK, "step", "speed", "turn", "spin", "moves", "roll", "rate")
"""Columns that say something of stages alone."""
MOST_TURN_RAD = math.pi / 2
"""From line to line: beyond, it is not clear which way the camera turned."""
_ROUNDING = 5e-3
"""By which printed rotations may miss being one: length of a quaternion, largest element of R^T R - 1."""
_WORDS = {"scan", "moves"}
_UNITS = {
    **dict.fromkeys((*PLACE, *CENTRE), _METRES),
    "step": _METRES | {f"{unit}/line": metres for unit, metres in _METRES.items()},
    "speed": {unit + per: m * s for unit, m in _METRES.items() for per, s in _A_SECOND.items()},
    "roll": _RADIANS,
    "turn": _RADIANS | {f"{unit}/line": radians for unit, radians in _RADIANS.items()},
    "spin": {unit + per: r * s for unit, r in _RADIANS.items() for per, s in _A_SECOND.items()}
    | {"rpm": 2 * math.pi / 60},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rate": {"hz": 1.0, "1/s": 1.0, "/s": 1.0, "fps": 1.0, "khz": 1e3},
    **{name: {} for name in ("line", *QUATERNION, *MATRIX, *LOOK, *DIRECTION, *AXIS)},
}
"""What numbers of a column are multiplied by for each unit that it may have: lengths become metres, angles radians,
times seconds."""
_LENGTHS = (*PLACE, *CENTRE, "step", "speed")
_DEGREES = ("roll", "turn", "spin")
"""Angles without a unit are degrees."""
_SAME = {"view": "scan", "file": "scan", "name": "scan", "row": "line", "frame": "line", "t": "time"}
_SAME |= {f"center_{axis}": f"centre_{axis}" for axis in PLACE}
_HEAD = re.compile(
    r"(?P<name>[a-z]+(?:_[xyz](?![a-z]))?[0-9]*)(?:\s*[(\[](?P<unit>[^)\]]+)[)\]]|_(?P<unit2>[a-zµμ°/]+))?"
)


@dataclass(frozen=True)
class TableRow:
    """One row of a table."""

    where: str
    """File and line, for messages."""
    cells: dict[str, float]
    """Numbers by the names of columns, in metres, radians and seconds where they have units; empty ones are absent."""
    words: dict[str, str]

    def vector(self, names: Sequence[str]) -> Float64[np.ndarray, " n"] | None:
        """Numbers of several columns; None where all are empty. Raises CaptureError: some are."""
        lacking = [name for name in names if name not in self.cells]
        if len(lacking) == len(names):
            return None
        if lacking:
            raise CaptureError(f"{self.where}: {name_some(lacking)} is empty; expected {', '.join(names)}")
        return np.array([self.cells[name] for name in names])

    def pose(self, camera_axes: str) -> Float64[np.ndarray, "3 4"]:
        """The pose that it says by a quaternion or a matrix, OpenGL axes. Raises CaptureError: it says none, both, or
        one that is no rotation.

        Args:
            camera_axes: That the rotation has: `opengl` or `opencv`.
        """
        place, quaternion, matrix = (self.vector(names) for names in (PLACE, QUATERNION, MATRIX))
        if place is None or (quaternion is None) == (matrix is None):
            found = (
                "no x, y, z" if place is None else "two rotations" if matrix is not None else "no rotation"
            )
            raise CaptureError(
                f"{self.where} has {found}; expected x, y, z and either {', '.join(QUATERNION)} or {MATRIX[0]} to "
                f"{MATRIX[-1]}, row by row, camera to world"
            )
        rotation = _rotation(quaternion, matrix, self.where)
        return np.column_stack([rotation @ FLIP if camera_axes == "opencv" else rotation, place])


def _rotation(
    quaternion: Float64[np.ndarray, "4"] | None, matrix: Float64[np.ndarray, "9"] | None, where: str
) -> Float64[np.ndarray, "3 3"]:
    from scipy.spatial.transform import Rotation

    if quaternion is not None:
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > _ROUNDING:
            raise CaptureError(f"{where}: the quaternion has the length {length:.4g}; expected 1")
        return Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
    assert matrix is not None
    rotation = matrix.reshape(3, 3)
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > _ROUNDING or np.linalg.det(rotation) < 0:
        what = "is a mirror image" if off <= _ROUNDING else f"is off a rotation by {off:.2g}"
        raise CaptureError(f"{where}: the matrix {what}; expected three orthonormal rows, camera to world")
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt


def line_rate(view: CaptureView, row: TableRow | None, options: ProcessOptions, what: str) -> float:
    """Lines a second: those that the table says, else the option, else the file. Raises CaptureError: none does; the
    message says `what` needs them."""
    own = None if row is None else row.cells.get("rate")
    rate = own or options.line_rate or view.cube.lines_per_second
    if rate is None or not rate > 0:
        raise CaptureError(
            f"{what} need the lines a second, which {view.cube.path.name} does not say; give --line-rate, or a "
            "movement from line to line (step, turn)"
        )
    return rate


@dataclass(frozen=True)
class ScanTable:
    """All rows, in the order of the file."""

    path: Path
    columns: tuple[str, ...]
    units: dict[str, str]
    """By column, as they are written; columns without one are absent."""
    rows: tuple[TableRow, ...]

    @property
    def metres_per_unit(self) -> float | None:
        """1 where lengths have units, which are brought to metres; None where the unit of the world is not known."""
        return 1.0 if "x" in self.units else None

    def refuse_columns(self, names: Sequence[str], why: str) -> None:
        """Refuse columns that do nothing in this kind of table. Raises CaptureError."""
        if found := [name for name in self.columns if name in names]:
            raise CaptureError(f"{self.path}: the column {name_some(found)} {why}; take it out")


def read_scan_table(path: Path) -> ScanTable:
    """Read a table with the columns x, y and z, and others that are known. Raises CaptureError: there is none, a column
    or a unit is not known, or a cell is no number."""
    lines, delimiter = text_lines(decode_text(read_table(path)))
    try:
        found = [_Read.of(path, lines, dialect) for dialect in possible_dialects(lines, delimiter)]
    except csv.Error as error:
        raise CaptureError(f"{path} is no table ({error})") from error
    tables = sorted((one for one in found if one is not None), key=lambda one: len(one.faults))
    if not tables:
        raise CaptureError(
            f"{path} has no line that names the columns x, y and z; expected a table of scans, such as "
            "'scan,line,x (mm),y (mm),z (mm),qw,qx,qy,qz' or one with a row a scan and what its stage did"
        )
    best = tables[0]
    if best.faults:
        raise CaptureError(best.faults[0])
    if not best.rows:
        raise CaptureError(f"{path} has no row below its head; expected one a line, or one a scan")
    return ScanTable(path, best.columns, best.units, tuple(best.rows))


@dataclass(frozen=True)
class _Read:
    """A table in one dialect, and what is wrong with it there."""

    columns: tuple[str, ...]
    units: dict[str, str]
    rows: list[TableRow]
    faults: list[str]

    @staticmethod
    def of(path: Path, lines: Sequence[str], dialect: Dialect) -> _Read | None:
        rows, faults = dialect.rows(lines), []
        for _, cells in rows:
            heads = [_HEAD.fullmatch(cell.lower().lstrip("# ")) for cell in cells]
            names = ["" if head is None else _SAME.get(head["name"], head["name"]) for head in heads]
            if set(PLACE) <= set(names):
                break
        else:
            return None
        known = (*_UNITS, *_WORDS)
        for cell in (cell for cell, name in zip(cells, names, strict=True) if name not in known):
            hint = did_you_mean(cell, known, form="; {}")
            faults.append(f"{path}: the column {cell!r} is not known{hint}; take it out, or see the guide")
        if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
            faults.append(f"{path}: the column {name_some(twice)} is there twice")
        units = {
            name: head["unit"] or head["unit2"]
            for name, head in zip(names, heads, strict=True)
            if head is not None and (head["unit"] or head["unit2"])
        }
        factors = _factors([name for name in names if name in _UNITS], units, path, faults)
        found = []
        for line, own in rows:
            where, numbers = f"{path}, line {line}", {}
            own_cells = dict(zip(names, own, strict=False))
            for name in (name for name in factors if own_cells.get(name)):
                value = dialect.number(own_cells[name])
                if value is None or not math.isfinite(value):
                    faults.append(f"{where}: {name} is {own_cells[name]!r}; expected a number")
                else:
                    numbers[name] = value * factors[name]
            words = {name: cell for name, cell in own_cells.items() if name in _WORDS}
            found.append(TableRow(where, numbers, words))
        return _Read(tuple(names), units, found, faults)


def _factors(names: Sequence[str], units: dict[str, str], path: Path, faults: list[str]) -> dict[str, float]:
    """What numbers of columns are multiplied by; notes units that are wrong."""
    factors = {}
    for name in names:
        unit = "".join(units.get(name, "").replace("µ", "u").replace("μ", "u").lower().split())
        factors[name] = math.pi / 180 if name in _DEGREES else 1.0
        if unit in _UNITS[name]:
            factors[name] = _UNITS[name][unit]
        elif unit:
            expected = (
                f"expected such as {name_some(list(_UNITS[name]), 5)}" if _UNITS[name] else "it has none"
            )
            faults.append(f"{path}: the column {name} has the unit {units[name]!r}; {expected}")
    stated, without = (
        [name for name in names if name in _LENGTHS and (name in units) is has_unit]
        for has_unit in (True, False)
    )
    if stated and without:
        faults.append(
            f"{path}: {name_some(stated)} has a unit and {name_some(without)} has none; name the unit of all lengths, "
            "or of none"
        )
    return factors
