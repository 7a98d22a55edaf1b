"""Files that a kill, a crash or a full disk at any moment leaves whole: the old one or the new one, never a part."""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from unmix_plugin.errors import RunError

CHUNK_BYTES = 1 << 26
"""Bytes handed to one write."""


class NewerFormatError(RunError):
    """A file of a run was written by a version newer than this one."""


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` to a temporary file in the same folder, force it to disk, then give it its name.

    Raises:
        RunError: the disk is full or refuses; `path` is as it was and no temporary file is left.
    """
    temporary = temporary_path(path)
    try:
        _write_synced(temporary, data)
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise RunError(
            f"can't write {path}: {error.strerror or error}; what was there before is untouched. "
            "Make room or choose another --output-dir, then go on with --load-run"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_json_atomically(path: Path, values: dict[str, Any]) -> None:
    """`write_atomically` of `values` as readable JSON.

    Raises:
        RunError: as `write_atomically`.
        TypeError: a value that JSON has no form for.
        ValueError: a number that is not finite.
    """
    write_atomically(path, (json.dumps(values, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path, newest_format: int) -> dict[str, Any]:
    """The object in a JSON file of a run.

    Raises:
        RunError: it is missing, cut off or no object.
        NewerFormatError: its format is newer than `newest_format`.
    """
    try:
        values = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise RunError(
            f"{path} is missing: the run is half-written or was moved in part; train again"
        ) from error
    except (OSError, ValueError) as error:
        raise RunError(f"can't read {path}: {error}; the run is damaged") from error
    if not isinstance(values, dict) or not isinstance(values.get("format_version"), int):
        raise RunError(f"{path} is no file of a run: it has no format_version")
    if values["format_version"] > newest_format:
        raise NewerFormatError(
            f"{path} has format {values['format_version']}, written by a newer version; "
            f"this one reads up to {newest_format}: update this package"
        )
    return values


def temporary_path(path: Path) -> Path:
    """Where `write_atomically` puts the bytes of `path` until they are complete."""
    return path.with_name(f".{path.name}.tmp")


def remove_stale_temporaries(folder: Path) -> None:
    """Remove what writers that were killed left behind in `folder`."""
    for path in folder.glob(".*.tmp"):
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Force the names in `folder` to disk; Windows has no such call and needs none."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write_synced(path: Path, data: bytes) -> None:
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, flags, 0o666)
    try:
        rest = memoryview(data)
        while len(rest) > 0:
            rest = rest[os.write(descriptor, rest[:CHUNK_BYTES]) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
