"""What comes from a browser, checked: numbers finite and within bounds, words known, file names harmless."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, TypeVar

from unmix_plugin.errors import ConfigError

LONGEST_TEXT = 100_000
"""Letters of a text that are looked at."""

_LONGEST_NAME = 64
_ChoiceT = TypeVar("_ChoiceT")


def number(value: Any, low: float | int, high: float | int, fallback: float | int) -> float:
    """A number within [low, high]; `fallback` for what is not a number or not finite.

    >>> number(7, 0, 5, fallback=1), number("x", 0, 5, fallback=1), number(float("nan"), 0, 5, fallback=1)
    (5.0, 1.0, 1.0)
    """
    try:
        found = float(value)
    except (TypeError, ValueError, OverflowError):
        return float(fallback)
    return min(max(found, float(low)), float(high)) if math.isfinite(found) else float(fallback)


def choice(value: Any, known: Collection[_ChoiceT], fallback: _ChoiceT) -> _ChoiceT:
    """The value if it is one of `known`, otherwise `fallback`."""
    return next((one for one in known if type(one) is type(value) and one == value), fallback)


def index_in(menu: Any) -> int:
    """Which of a menu's options is chosen.

    Raises:
        ConfigError: none of them.
    """
    options = tuple(menu.options)
    if menu.value not in options:
        raise ConfigError(f"there is no {menu.label} {str(menu.value)[:40]!r}")
    return options.index(menu.value)


def text(value: Any) -> str:
    """What was typed, cut to `LONGEST_TEXT`; empty for what is not text."""
    return value[:LONGEST_TEXT] if isinstance(value, str) else ""


def new_file(folder: Path, name: Any, suffix: str, fallback: str) -> Path:
    """A path directly in `folder` that no file has, named as asked as far as that is safe.

    Args:
        folder: Where; it need not exist.
        name: What was typed. Anything but letters, digits, `_`, `-` and inner dots becomes `_`.
        suffix: Ending, with its dot.
        fallback: Used where nothing is left of the name.
    Raises:
        ConfigError: there are too many files of that name.
    """
    cleaned = re.sub(r"[^A-Za-z0-9_.-]", "_", text(name)[:_LONGEST_NAME].strip()).strip("._")
    stem = cleaned.removesuffix(suffix).strip("._") or fallback
    for count in range(1, 10_000):
        path = folder / f"{stem if count == 1 else f'{stem}-{count}'}{suffix}"
        if not path.exists():
            return path
    raise ConfigError(f"too many files named {stem} in {folder}; choose another name")
