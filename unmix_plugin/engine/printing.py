"""How texts of users and files, such as names of views and materials, are put where a reader has a syntax of its own.

| where | rule |
|---|---|
| terminal, `run.log`, `report.txt` | `terminal_text`: no letter that steers a terminal or turns the reading direction |
| a figure | `plot_text`: no formula of matplotlib's, and no letter that fonts lack because terminals obey it |
| a CSV file | `cell_text`: no formula of a spreadsheet |
| HTML | `html.escape`, and Jinja's `autoescape`; scripts set `textContent` |

Commands print by `tell` and by consoles that render through `cleaned`; ruff refuses `print` in the package.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from rich.segment import Segment

_NOT_FOR_TERMINALS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u061c\u2028-\u202e\u2066-\u2069]")
"""Control characters but tab and line feed; Unicode's marks, embeddings, overrides and isolates of direction, and its
separators of lines and paragraphs."""
_FORMULA_STARTS = ("=", "+", "-", "@", "\t")
"""First letters by which spreadsheets take a cell for a formula (OWASP, CSV injection)."""


def terminal_text(text: str) -> str:
    """A text for a terminal, with `?` in place of each letter that would steer it.

    >>> terminal_text("grass\\x1b[2J \\u202egnp.exe")
    'grass?[2J ?gnp.exe'
    """
    return _NOT_FOR_TERMINALS.sub("?", text)


@runtime_checkable
class Stream(Protocol):
    """What text can be printed to: standard streams, and what stands for them in tests."""

    def write(self, text: str, /) -> object: ...

    def flush(self) -> object: ...


def tell(text: object = "", file: Stream | None = None) -> None:
    """Print a line, at once; on standard output unless another stream is given."""
    print(terminal_text(str(text)), file=file or sys.stdout, flush=True)


def cleaned(segments: Iterable[Segment]) -> Iterator[Segment]:
    """What a rich console renders, with texts as terminals may have them; its own control codes stay."""
    for segment in segments:
        yield segment if segment.control else segment._replace(text=terminal_text(segment.text))


def plot_text(text: str) -> str:
    """A text as matplotlib draws it letter by letter: it takes what stands between two `$` for a formula, and leaves
    labels that begin with `_` out of legends.

    >>> print(plot_text("5$ a_1 $"), plot_text("_leaf"))
    5\\$ a_1 \\$  _leaf
    """
    escaped = terminal_text(text).replace("$", r"\$")
    return f" {escaped}" if escaped.startswith("_") else escaped


def cell_text(text: str) -> str:
    """A text as a cell of a CSV file: one that a spreadsheet would take for a formula gets `_` before it; numbers stay.

    >>> cell_text("=1+1"), cell_text("-0.5"), cell_text("leaf")
    ('_=1+1', '-0.5', 'leaf')
    """
    # A carriage return, which Python's writer leaves unquoted, ends a row for readers.
    text = text.replace("\r", "_")
    if not text.startswith(_FORMULA_STARTS):
        return text
    try:
        float(text)
    except ValueError:
        return f"_{text}"
    return text
