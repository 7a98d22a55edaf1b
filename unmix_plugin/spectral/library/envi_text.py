"""The text of an ENVI header as entries: `key = value` lines after the word ENVI.

Lists are in braces and may span lines; a line that begins with `;` is a comment.
"""

from __future__ import annotations

import re

_KEY = re.compile(r"^[ \t]*([^=\n{}]*?)[ \t]*=(?:\s*(?=\{)|[ \t]*)", re.MULTILINE)
_BRACE = re.compile(r"[{}]")


def parse_envi_header(text: str) -> dict[str, str]:
    r"""Values by key; keys in lower case with single spaces, lists without their braces.

    Raises:
        ValueError: the text is no ENVI header, or a list in it is never closed.

    >>> parse_envi_header("ENVI\n; by hand\nBands = 2\nwavelength = {\n450,\n; half\n550}")
    {'bands': '2', 'wavelength': '450,\n550'}
    """
    lines = [line for line in text.lstrip("\ufeff").splitlines() if not line.lstrip().startswith(";")]
    if not lines or lines[0].strip() != "ENVI":
        raise ValueError("its first line is not 'ENVI'")
    body, position = "\n".join(lines[1:]), 0
    header: dict[str, str] = {}
    while match := _KEY.search(body, position):
        key, start = " ".join(match[1].lower().split()), match.end()
        if body[start : start + 1] == "{":
            position = _closing_brace(body, start, key) + 1
            header[key] = body[start + 1 : position - 1].strip()
        else:
            position = (body + "\n").index("\n", start)
            header[key] = body[start:position].strip()
    return header


def _closing_brace(body: str, start: int, key: str) -> int:
    """Where the list ends that the brace at `start` opens."""
    depth = 0
    for brace in _BRACE.finditer(body, start):
        depth += 1 if brace[0] == "{" else -1
        if depth == 0:
            return brace.start()
    first = body.find("}", start)
    if key == "description" and first >= 0:  # free text, in which a brace need have no partner
        return first
    raise ValueError(f"the list of '{key}' is never closed")
