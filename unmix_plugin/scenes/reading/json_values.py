"""JSON of unknown origin: the text, and single values in it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any


class UnreadableJsonError(ValueError):
    """A file holds no JSON; the text says why."""


def read_json_file(path: Path) -> Any:
    """The value in a JSON file.

    Raises:
        UnreadableJsonError: it is not UTF-8, not JSON, nested too deeply, or has text that is not Unicode.
        OSError: it cannot be opened.
    """
    data = path.read_bytes()
    if not data.strip(b"\xef\xbb\xbf\t\r\n "):
        raise UnreadableJsonError("is empty; expected JSON")
    try:
        content = json.loads(data.decode("utf-8-sig"))
        json.dumps(
            content, ensure_ascii=False
        ).encode()  # fails on lone surrogates, which no file name can hold
    except json.JSONDecodeError as error:
        at = f"line {error.lineno}, column {error.colno}"
        raise UnreadableJsonError(f"is not valid JSON ({error.msg} at {at}); was it cut short?") from error
    except (
        ValueError,
        RecursionError,
    ) as error:  # not UTF-8, surrogates, numbers of thousands of digits, nesting
        raise UnreadableJsonError(f"is not readable as JSON ({type(error).__name__})") from error
    return content


def describe(value: Any) -> str:
    """A JSON value in a few words, for messages."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else f"a list of {len(value)}"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "..."


def read_number(value: Any) -> float | None:
    """A finite number, or None; true and false don't count as numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
