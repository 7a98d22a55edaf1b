"""Values of JSON of unknown origin: described in messages, and converted key by key to what a schema asks for.

A schema is a `msgspec.Struct` whose fields are optional and say by `Meta(description=...)` what is expected. Every
wrong value is noted, not only the first, so that a user mends a file in one go.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec
import numpy as np


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


def read_numbers(value: Any, *shape: int) -> np.ndarray | None:
    """A list of so many finite numbers, or of so many such lists, as an array; None if it is anything else."""
    if not isinstance(value, list) or len(value) != shape[0]:
        return None
    parts = [read_numbers(part, *shape[1:]) if shape[1:] else read_number(part) for part in value]
    return None if any(part is None for part in parts) else np.array(parts, dtype=np.float64)


Keys = TypeVar("Keys", bound=msgspec.Struct)


def read_keys(values: Mapping[str, Any], schema: type[Keys], note: Callable[..., Any]) -> Keys:
    """What an object holds of the keys of a schema; None for those that are absent, null or wrong.

    Args:
        note: Takes `key`, the value that was `found` and what was `expected` of each key whose value is wrong, in
        words.
    """
    found = {}
    for key, (kind, expected) in _kinds(schema).items():
        value = values.get(key)
        if value is None:
            continue
        try:
            found[key] = msgspec.convert(value, kind)
        except msgspec.ValidationError:
            note(key=key, found=describe(value), expected=expected)
    return schema(**found)


@cache
def _kinds(schema: type[msgspec.Struct]) -> dict[str, tuple[Any, str]]:
    """Type and description of each key."""
    kinds = {}
    for key, kind in get_type_hints(schema, include_extras=True).items():
        notes = [note for part in (kind, *get_args(kind)) for note in getattr(part, "__metadata__", ())]
        kinds[key] = kind, next((note.description for note in notes), "another value")
    return kinds
