"""The files that a scene is made of: which they are, and their hashes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.faults import sha256_of


def stamps(paths: Iterable[Path]) -> list[list[Any]]:
    """Path, size and time of change of each file: what tells quickly whether it is still the same.

    Raises:
        CaptureError: a file is gone.
    """
    found = []
    for path in paths:
        for file in _files_of(path):
            with _reading(file):
                facts = file.stat()
            found.append([os.fspath(file.absolute()), facts.st_size, facts.st_mtime_ns])
    return found


def hashes(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Path, size and SHA-256 of each file.

    Raises:
        CaptureError: a file can't be read.
    """
    found = []
    for path in paths:
        for file in _files_of(path):
            with _reading(file):
                found.append(
                    {"path": os.fspath(file), "bytes": file.stat().st_size, "sha256": sha256_of(file)}
                )
    return found


def _files_of(path: Path) -> list[Path]:
    """The file, or those of a folder that a reader takes as one."""
    return sorted(child for child in path.iterdir() if child.is_file()) if path.is_dir() else [path]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Context in which an error of the system becomes one of reading `path`."""
    try:
        yield
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
