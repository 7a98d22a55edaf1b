"""A reader of files that strangers make: valid samples, how to read damaged ones, and what it may raise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.mutation import Mutator, mutate_bytes


@dataclass(frozen=True)
class Reader:
    """One reader under test."""

    samples: tuple[bytes, ...]
    """Valid inputs, of many kinds."""
    file_name: str
    """What the file is called that `read` gets."""
    read: Callable[[Path], object]
    """Reads a file; nothing else lies beside it but what `companions` names."""
    allowed: tuple[type[Exception], ...]
    """What it may raise."""
    mutate: Mutator = mutate_bytes
    companions: tuple[tuple[str, bytes], ...] = ()
    """Names and contents of files beside it."""
