"""Files that grow piece by piece, or that a library or a program writes: they get their name when they are complete."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from unmix_plugin.atomic_files import temporary_path
from unmix_plugin.errors import RunError
from unmix_plugin.formats.files import make_folder


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Context that gives a temporary name in the folder of `path`, which is made.

    At the end of the block the file under that name is forced to disk and becomes `path`. If the block fails, nothing
    is left of it and `path` is as it was.

    Raises:
        RunError: the folder can't be made, or the file can't get its name.
    """
    make_folder(path.parent)
    temporary = temporary_path(path)
    try:
        yield temporary
        with blaming(path):
            _force_to_disk(temporary)
            temporary.replace(path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def blaming(path: Path) -> Iterator[None]:
    """Context in which an error of the system is told as one of writing `path`.

    Raises:
        RunError: the disk is full or refuses.
    """
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error.strerror or str(error)) from error


def cannot_write(path: Path, reason: str) -> RunError:
    """The error of a file that can't be written."""
    return RunError(f"can't write {path}: {reason}; make room or choose another folder")


def _force_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
