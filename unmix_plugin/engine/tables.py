"""Tables as text: written as CSV, and read as spreadsheets of any country and programs of any age write them.

A table is read in a dialect, what parts its columns and what its decimal sign is. A name of a file, view or material
that is written is no formula to a spreadsheet.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from unmix_plugin.engine.printing import cell_text

_MARKED = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins with the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_SEP_LINE = re.compile(r'"?sep=(.)"?[;,\t]*', re.IGNORECASE)
"""The first line by which spreadsheets tell each other what parts the columns."""
_UNUSED_BY_WINDOWS = bytes.maketrans(b"\x81\x8d\x8f\x90\x9d", b"?" * 5)
_NOT_MEASURED = frozenset(("", "nan", "na", "n/a", "n.a.", "#n/a", "#nv", "null", "none", "-", "--", "*"))
_PLAIN_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[ed][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE)


def decode_text(data: bytes) -> str:
    """A text in UTF-8, UTF-16 or UTF-32, or in the eight bits of Windows where it is none of these."""
    for mark, encoding in _MARKED:
        if data.startswith(mark):
            return data.decode(encoding, "replace")
    begin = data[:4096]
    if begin.count(0) > len(begin) // 4:  # zeros stand between the letters of UTF-16
        return data.decode("utf-16-be" if begin[:1] == b"\0" else "utf-16-le", "replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.translate(_UNUSED_BY_WINDOWS).decode("cp1252")


@dataclass(frozen=True)
class Dialect:
    """How a table is written."""

    delimiter: str
    """One letter; a blank stands for any white space."""
    decimal: str
    """A point or a comma."""

    def __str__(self) -> str:
        parts = {"\t": "tabs", " ": "white space", ",": "commas", ";": "semicolons"}
        signs = {".": "points", ",": "commas"}
        return f"{parts.get(self.delimiter, repr(self.delimiter))} between columns and decimal {signs[self.decimal]}"

    def rows(self, lines: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
        """The number of each line that is not blank, from 1, and its cells without the white space around them.

        Raises:
            csv.Error: a cell is too long, or its quotes don't end.
        """
        if self.delimiter == " ":
            yield from ((number, line.split()) for number, line in enumerate(lines, 1) if line.strip())
            return
        reader = csv.reader(lines, delimiter=self.delimiter)
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield reader.line_num, [cell.strip() for cell in cells]

    def number(self, cell: str) -> float | None:
        """The number that a cell holds, NaN where it says that nothing was measured; None for other words.

        >>> (
        ...     Dialect(";", ",").number("0,25"),
        ...     Dialect(";", ",").number("N/A"),
        ...     Dialect(";", ",").number("0.25"),
        ... )
        (0.25, nan, None)
        """
        text = cell.strip().lower()
        if text in _NOT_MEASURED:
            return float("nan")
        if self.decimal == ",":
            text = "" if "." in text or text.endswith(",") else text.replace(",", ".")
        return float(text.replace("d", "e")) if _PLAIN_NUMBER.fullmatch(text) else None

    def is_number(self, cell: str) -> bool:
        """Whether a cell holds a number that was measured."""
        value = self.number(cell)
        return value is not None and value == value


def text_lines(text: str) -> tuple[list[str], str | None]:
    """The lines of a table, blank ones too, and the delimiter that a first line such as `sep=;` names, which becomes
    blank itself."""
    lines = text.splitlines()
    stated = _SEP_LINE.fullmatch(lines[0].strip(" ")) if lines else None
    return (["", *lines[1:]], stated[1]) if stated else (lines, None)


def possible_dialects(lines: Sequence[str], delimiter: str | None = None) -> list[Dialect]:
    """All in which a table may be written; one whose delimiter is stated has that."""
    delimiters = [one for one in (";", "\t", ",", "|") if any(one in line for line in lines)] + [" "]
    decimals = [".", ","] if any("," in line for line in lines) else ["."]
    # A comma is both only where quotes tell one from the other.
    is_quoted = any('"' in line for line in lines)
    return [
        Dialect(one, decimal)
        for one in ([delimiter] if delimiter else delimiters)
        for decimal in decimals
        if (one, decimal) != (",", ",") or is_quoted
    ]


_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:e[+-]?\d+)?", re.IGNORECASE)


def named_rows(text: str, names: Sequence[str]) -> tuple[Dialect, list[tuple[int, dict[str, str]]]] | None:
    """The rows below the first line that has all of these names, in small letters, each with the number of its line and
    its cells by their head; and the dialect of their numbers. None where no line has them.

    Raises:
        csv.Error: it is no table.
    """
    lines, delimiter = text_lines(text)
    for dialect in possible_dialects(lines, delimiter):
        head: list[str] | None = None
        found: list[tuple[int, dict[str, str]]] = []
        for line, cells in dialect.rows(lines):
            if head is not None:
                found.append((line, dict(zip(head, cells, strict=False))))
            elif set(names) <= (heads := {cell.lower().lstrip("# ") for cell in cells}) and len(heads) == len(
                cells
            ):
                head = [cell.lower().lstrip("# ") for cell in cells]
        if head is not None:
            is_comma = dialect.delimiter != "," and any(
                _DECIMAL_COMMA.fullmatch(cell) for _, row in found for cell in row.values()
            )
            return Dialect(dialect.delimiter, "," if is_comma else "."), found
    return None


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
