"""The JSON files of a run: one format version for all of them, and nothing read that can't be meant."""

import json
import math
import os
from pathlib import Path
from typing import Any

from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.errors import RunError

RUN_FORMAT = 2
"""Version of everything in a run folder; raised when an older version of this package could not read it."""

_DEEPEST = 32
_LARGEST_INTEGER = 2**63


class OtherFormatError(RunError):
    """A file of a run was written by a version of this package that is too new or too old."""


def write_run_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` and the format version as readable JSON, whole or not at all.

    Raises:
        RunError: the disk is full or refuses.
        TypeError: a value that JSON has no form for.
        ValueError: a number that is not finite.
    """
    text = json.dumps({"format_version": RUN_FORMAT, **values}, indent=1, allow_nan=False)
    write_file(path, (text + "\n").encode())


def read_run_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file of a run.

    Raises:
        RunError: it is missing, cut off, or holds what no run writes.
        OtherFormatError: another version of this package wrote it.
    """
    try:
        values = json.loads(path.read_bytes())
        _require_plain(values, _DEEPEST)
    except FileNotFoundError as error:
        raise RunError(
            f"{path} is missing: the run is half-written or was moved in part; train again"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise RunError(f"can't read {path}: {error}; the run is damaged") from error
    version = values.get("format_version") if isinstance(values, dict) else None
    if type(version) is not int:
        raise RunError(f"{path} is not a file of a run: it has no format_version")
    if version > RUN_FORMAT:
        raise OtherFormatError(
            f"{path} has format {version}, written by a newer version; this one reads format {RUN_FORMAT}: "
            "update this package"
        )
    if version < RUN_FORMAT:
        raise OtherFormatError(
            f"{path} has format {version}, written by an older version; this one reads format {RUN_FORMAT}: "
            "train again, or use the version that trained it"
        )
    return values


def _require_plain(value: Any, depth: int) -> None:
    """Refuse what Python's JSON reader accepts and no run writes."""
    if depth == 0:
        raise ValueError(f"nested more than {_DEEPEST} levels deep")
    if isinstance(value, dict):
        for key, entry in value.items():
            _require_plain(key, depth - 1)
            _require_plain(entry, depth - 1)
    elif isinstance(value, list):
        for entry in value:
            _require_plain(entry, depth - 1)
    elif isinstance(value, str):
        os.fsencode(value)  # may become a path; raises for a lone surrogate
        if "\0" in value:
            raise ValueError(f"text with a null character: {value[:40]!r}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"the number {value}")
    elif isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
        raise ValueError("an integer beyond 64 bits")
