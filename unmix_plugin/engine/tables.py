"""Tables as CSV, in which no name of a file, view or material is a formula to a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

from unmix_plugin.engine.printing import cell_text


def csv_bytes(rows: Iterable[Sequence[object]]) -> bytes:
    """A table as the bytes of a CSV file; numbers come as text in the precision wanted.

    A text that a spreadsheet would take for a formula gets `_` before it; numbers stay.

    >>> csv_bytes([["name", "value"], ["=1+1", "-0.5"], ["leaf", 3]]).decode().split()
    ['name,value', '_=1+1,-0.5', 'leaf,3']
    """
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(
        [cell_text(value) if isinstance(value, str) else value for value in row] for row in rows
    )
    return text.getvalue().encode()
