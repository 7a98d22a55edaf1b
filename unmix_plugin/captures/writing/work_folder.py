"""The folder beside the output in which a scene is made, and the files that it is made of.

Views that are done survive a kill, and nothing takes the folder for a scene, as it has no transforms.json and is called
unfinished.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from unmix_plugin.captures.writing.view_files import ViewRecord
from unmix_plugin.engine.runs.atomic_files import (
    make_folder,
    remove_stale_temporaries,
    write_errors_as,
    write_file,
)
from unmix_plugin.errors import CaptureError, ConfigError
from unmix_plugin.scenes.reading.faults import sha256_of

RECORD_NAME = "process.json"
_PLAN, _VIEWS, _POSES = "plan.json", "views", "poses"


class WorkFolder:
    """The unfinished scene of one output folder."""

    def __init__(self, output: Path) -> None:
        self.output = output.resolve()
        self.path = self.output.with_name(f"{self.output.name}.unfinished")
        """Where files are written until the scene is complete."""
        self.poses = self.path / _POSES
        """Where files of the estimation of poses lie while it runs, or after it failed."""

    def begin(self, plan: dict[str, Any]) -> bool:
        """Make the folder, or go on in the one that an interrupted start left.

        Args:
            plan: Options, decisions and inputs; views that were made with other ones are thrown away.
        Returns:
            Whether an earlier start is gone on with.
        Raises:
            ConfigError: there is a folder of this name that is not ours.
            RunError: it can't be written.
        """
        plan_file, text = self.path / _PLAN, _json(plan)
        if self.path.exists():
            if not plan_file.is_file() and any(self.path.iterdir()):
                raise ConfigError(
                    f"{self.path} is in the way and was not made by unmix-process; rename it or choose another "
                    "--output-dir"
                )
            if plan_file.is_file() and plan_file.read_bytes() == text:
                for folder in ("cubes", "images", "masks", _VIEWS):
                    remove_stale_temporaries(self.path / folder)
                return True
            with write_errors_as(self.path):
                shutil.rmtree(self.path)
        make_folder(self.path)
        write_file(plan_file, text)
        return False

    def done(self, name: str) -> ViewRecord | None:
        """What is recorded of a view that is written; None if it is not."""
        try:
            return ViewRecord(**json.loads(self._record(name).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def note(self, record: ViewRecord) -> None:
        """Record that a view is written."""
        write_file(self._record(record.name), _json(asdict(record)))

    def finish(self, overwrite: bool) -> None:
        """Give the scene its name; the record of how it was made stays in it.

        Raises:
            RunError: it can't be moved.
        """
        with write_errors_as(self.output):
            old = self.output.with_name(f"{self.output.name}.old")
            if overwrite and self.output.exists():
                self.output.rename(old)
            elif self.output.exists():
                self.output.rmdir()  # empty, see refuse_output
            self.path.rename(self.output)
            # After a kill here, the scene is whole and has some files too many.
            for name in (_VIEWS, _POSES):
                shutil.rmtree(self.output / name, ignore_errors=True)
            (self.output / _PLAN).unlink()
            shutil.rmtree(old, ignore_errors=True)

    def _record(self, name: str) -> Path:
        return self.path / _VIEWS / f"{name}.json"


def refuse_output(output: Path, overwrite: bool) -> None:
    """Look before anything is computed whether the scene can get its name.

    Raises:
        ConfigError: the folder holds something; with `overwrite`, something that this command did not make.
    """
    if not output.resolve().name:
        raise ConfigError(f"{output} can't be a scene; give a folder of its own with --output-dir")
    if output.is_file():
        raise ConfigError(f"{output} is a file; give a folder with --output-dir")
    if not output.is_dir() or not any(output.iterdir()):
        return
    if not (output / RECORD_NAME).is_file():
        raise ConfigError(f"{output} is not empty; give a new folder with --output-dir")
    if not overwrite:
        raise ConfigError(
            f"{output} holds a scene already; choose another folder, or replace it with --overwrite"
        )


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True) + "\n").encode()


def stamps(paths: Iterable[Path]) -> list[list[Any]]:
    """Path, size and time of change of each file: what tells quickly whether it is still the same.

    Raises:
        CaptureError: a file is gone.
    """
    found = []
    for file in _files_of(paths):
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
    for file in _files_of(paths):
        with _reading(file):
            found.append({"path": os.fspath(file), "bytes": file.stat().st_size, "sha256": sha256_of(file)})
    return found


def _files_of(paths: Iterable[Path]) -> Iterator[Path]:
    """Files, and those of a folder that a reader takes as one."""
    for path in paths:
        yield from sorted(child for child in path.iterdir() if child.is_file()) if path.is_dir() else [path]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Context in which an error of the system becomes one of reading `path`."""
    try:
        yield
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
