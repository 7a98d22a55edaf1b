"""Single values out of JSON of unknown make."""

from __future__ import annotations

import json
import math
from typing import Any


def describe(value: Any) -> str:
    """A JSON value in a few words, for messages."""
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else f"a list of {len(value)}"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "..."


def read_number(value: Any) -> float | None:
    """A finite number, or None; true and false are no numbers here though Python counts with them."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
