"""Tables as CSV, in which no name of a file, view or material is a formula to a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

_FORMULA_STARTS = ("=", "+", "-", "@", "\t")
"""First letters by which spreadsheets take a cell for a formula (OWASP, CSV injection)."""


def csv_bytes(rows: Iterable[Sequence[object]]) -> bytes:
    """A table as the bytes of a CSV file; numbers come as text in the precision wanted.

    A text that a spreadsheet would take for a formula gets `_` before it; numbers stay.

    >>> csv_bytes([["name", "value"], ["=1+1", "-0.5"], ["leaf", 3]]).decode().split()
    ['name,value', '_=1+1,-0.5', 'leaf,3']
    """
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue().encode()


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return value
    # A carriage return, which Python's writer leaves unquoted, ends a row for readers.
    value = value.replace("\r", "_")
    if not value.startswith(_FORMULA_STARTS):
        return value
    try:
        float(value)
    except ValueError:
        return f"_{value}"
    return value
