"""The JSON files of a run: one format version for all of them, and nothing is read that no run writes.

A run of format 7 opens in every later version: files of older formats are brought to the present one, a step a version.
A step takes the values of any JSON file of a run (it looks for what it changes) and gives those of the next format; it
stays as it is for ever, so what it fills in is written out here and not taken from settings, whose defaults may change.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from unmix_plugin.engine.runs.atomic_files import write_errors_as, write_file
from unmix_plugin.engine.runs.replacing import hash_of, is_ours, list_file
from unmix_plugin.errors import RunError
from unmix_plugin.limits import DEEPEST, UnreadableJsonError, parse_json, read_json

OLDEST_FORMAT, RUN_FORMAT = 7, 8
"""Versions of everything in a run folder that this package reads, and writes; the latter is raised, with a step in
`_STEPS`, when an older version of this package could not read what is written."""

_LARGEST_INTEGER = 2**63
_LARGEST_NUMBER = 1e18
"""Of scenes, poses and lights none comes near; what is computed from larger ones would leave float32."""


class OtherFormatError(RunError):
    """A file of a run was written by a version of this package that is too new or too old."""


def _with_first_smallest_weight(values: dict[str, Any]) -> dict[str, Any]:
    """Format 8: what was `auto` and follows from the scene stands as a value in config.json, as the model settles it
    when it is opened; and the renderer's weight at the start of training is a setting of its own."""
    config: Any = values.get("config")
    try:
        pipeline = config["pipeline"]
        renderer = {"first_smallest_weight": "auto", **pipeline["model"]["renderer"]}
        if "smallest_weight" not in renderer:
            return values
    except (KeyError, TypeError):  # another file, or one that is refused when it is read
        return values
    model = {**pipeline["model"], "renderer": renderer}
    return {**values, "config": {**config, "pipeline": {**pipeline, "model": model}}}


_STEPS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {7: _with_first_smallest_weight}


def read_run_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file of a run, in the present format.

    Raises:
        RunError: it is missing, cut off, or holds what no run writes.
        OtherFormatError: another version of this package wrote it.
    """
    try:
        values = read_plain_json(path)
    except FileNotFoundError as error:
        raise RunError(
            f"{path} is missing: the run is half-written or was moved in part; train again"
        ) from error
    version = values.get("format_version") if isinstance(values, dict) else None
    if type(version) is not int:
        raise RunError(f"{path} is not a file of a run: it has no format_version")
    if not OLDEST_FORMAT <= version <= RUN_FORMAT:
        age, advice = ("a newer", "update this package")
        if version < RUN_FORMAT:
            age, advice = ("an older", "train again, or use the version that trained it")
        raise OtherFormatError(
            f"{path} has format {version}, written by {age} version; this one reads formats {OLDEST_FORMAT} to "
            f"{RUN_FORMAT}: {advice}"
        )
    for older in range(version, RUN_FORMAT):
        values = {**_STEPS[older](values), "format_version": older + 1}
    return values


def read_plain_json(path: Path) -> Any:
    """The value in any JSON file of a run folder.

    Raises:
        FileNotFoundError: there is none.
        RunError: it is no regular file, too long, cut off, or holds what no run writes.
    """
    try:
        value = read_json(path)
        require_plain(value)
    except FileNotFoundError:
        raise
    except UnreadableJsonError as error:
        raise RunError(f"{path} {error}; the run is damaged") from error
    except (OSError, ValueError) as error:
        raise RunError(
            f"can't read {path}: {getattr(error, 'strerror', None) or error}; the run is damaged"
        ) from error
    return value


def parse_plain_json(text: str) -> Any:
    """The value in a text of JSON. Raises ValueError: it is none, or holds what no run writes."""
    value = parse_json(text)
    require_plain(value)
    return value


def require_plain(value: Any, depth: int = DEEPEST) -> None:
    """Refuse what Python's JSON reader accepts and no run writes.

    Raises:
        ValueError: values are nested more than `depth` levels deep, a number is too large, or a text can't be a path.
    """
    if depth == 0:
        raise ValueError(f"nested more than {DEEPEST} levels deep")
    if isinstance(value, dict | list):
        for entry in [*value, *value.values()] if isinstance(value, dict) else value:
            require_plain(entry, depth - 1)
    elif isinstance(value, str):
        os.fsencode(value)  # raises for a lone surrogate
        if "\0" in value:
            raise ValueError(f"text with a null character: {value[:40]!r}")
    elif isinstance(value, float) and not abs(value) <= _LARGEST_NUMBER:
        raise ValueError(f"the number {value}")
    elif isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
        raise ValueError("an integer beyond 64 bits")


def write_run_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` and the format version as readable JSON, whole or not at all, in place of a file of a run, be it
    from before lists of files were kept, or edited by hand, which the caller has read.

    Raises:
        RunError: the disk is full or refuses, or a file is there that no run wrote.
        TypeError, ValueError: a value that JSON has no form for, or a number that is not finite.
    """
    text = json.dumps({"format_version": RUN_FORMAT, **values}, indent=1, allow_nan=False)
    with write_errors_as(path):
        adopt_run_json(path)
    write_file(path, (text + "\n").encode())


def adopt_run_json(path: Path) -> None:
    """Make a file that reads as one of a run one that may be replaced and removed. Raises OSError."""
    if os.path.lexists(path) and not is_ours(path):
        with contextlib.suppress(RunError):
            read_run_json(path)
            list_file(path, hash_of(path))
