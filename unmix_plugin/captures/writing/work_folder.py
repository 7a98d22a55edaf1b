"""The unfinished folder beside the output, in which a scene gathers until it is complete; and the files that the scene
is made of, by which an interrupted start tells whether it can be resumed."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin import __version__
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.options import ProcessOptions, plain_options
from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.poses.estimation import WORK_FILES
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import reading
from unmix_plugin.captures.writing.view_files import ViewRecord
from unmix_plugin.engine.runs.atomic_files import make_folder, write_errors_as, write_file
from unmix_plugin.engine.runs.replacing import (
    TEMPORARY,
    is_ours,
    move_aside,
    refuse_folder,
    remove,
    remove_folder,
    remove_stale_temporaries,
)
from unmix_plugin.engine.runs.run_folder import RunLock
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import hash_of

RECORD_NAME = "process.json"
"""How a scene was made: in each that this command wrote."""
_PLAN, _VIEWS, _POSES, _LOCK = "plan.json", "views", "poses", "process.lock"
_SCRATCH = re.compile(rf"{_LOCK}|(.*/)?{TEMPORARY.pattern}|{_POSES}/({WORK_FILES.pattern})")
"""What the unfinished folder has beside listed files: the lock, what killed writers left, and COLMAP's files."""


class WorkFolder:
    """The unfinished scene of one output folder. Views that are done survive a kill, and nothing takes the folder for a
    scene, as it has no transforms.json and is called unfinished."""

    def __init__(self, output: Path) -> None:
        self.output = output.resolve()
        self.path = self.output.with_name(f"{self.output.name}.unfinished")
        """Where files are written until the scene is complete."""
        self._lock: RunLock | None = None
        self.poses = self.path / _POSES
        """Where files of the estimation of poses lie while it runs, or after it failed."""

    def refuse_foreign(self) -> None:
        """Look before anything is computed whether the folder is this command's, and holds nothing else. Raises
        ConfigError."""
        if os.path.lexists(self.path):
            if self.path.is_dir() and any(self.path.iterdir()) and not is_ours(self.path / _PLAN):
                raise ConfigError(f"{self.path} is in the way and was not made by unmix-process; rename it")
            refuse_folder(self.path, _SCRATCH)

    def begin(self, plan: dict[str, Any]) -> bool:
        """Make the folder, or resume the one that an interrupted start left.

        Views that were made with another plan (options, decisions and inputs) are thrown away.

        Returns:
            Whether an earlier start is resumed.
        Raises:
            ConfigError: there is a folder of this name that is not ours, or has something in it that is not.
            RunError: it can't be written.
        """
        plan_file, text = self.path / _PLAN, _json(plan)
        if plan_file.is_file():
            self._hold()
        self.refuse_foreign()
        if plan_file.is_file():
            if plan_file.read_bytes() == text:
                for folder in ("cubes", "images", "masks", _VIEWS):
                    remove_stale_temporaries(self.path / folder)
                return True
            if self._lock is not None:
                self._lock.release()  # Windows removes no file that is open
            with write_errors_as(self.path):
                remove_folder(self.path, _SCRATCH)
        make_folder(self.path)
        self._hold()
        write_file(plan_file, text)
        return False

    def _hold(self) -> None:
        """Let no other process write the same scene, until this one ends; RunError where another one does."""
        if self._lock is not None:
            self._lock.release()
        self._lock = RunLock(self.path / _LOCK, "unmix-process")

    def done(self, name: str) -> ViewRecord | None:
        """What is recorded of a view that is written; None if it is not."""
        try:
            return ViewRecord(**json.loads(self._record(name).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def note(self, record: ViewRecord) -> None:
        """Record that a view is written."""
        write_file(self._record(record.name), _json(asdict(record)))

    def finish(self, overwrite: bool) -> list[str]:
        """Give the scene its name; the record of how it was made stays in it.

        Returns:
            What of an earlier scene is still there, in words.
        Raises:
            ConfigError: files that are not ours came into the earlier scene meanwhile.
            RunError: it can't be moved.
        """
        earlier = None
        with write_errors_as(self.output):
            if self._lock is not None:
                self._lock.release()
            if overwrite and self.output.exists():
                refuse_folder(self.output)
                earlier = move_aside(self.output, "replaced")
            elif self.output.exists():
                self.output.rmdir()  # empty, see refuse_output
            self.path.rename(self.output)
            # After a kill here, the scene is whole and has some files too many.
            remove_folder(self.output / _VIEWS)
            remove_folder(self.output / _POSES, WORK_FILES)
            remove(self.output / _PLAN)
            (self.output / _LOCK).unlink(missing_ok=True)
            if earlier is not None and remove_folder(earlier):
                return [f"{earlier} keeps files of the earlier scene that unmix-process did not write"]
        return []

    def _record(self, name: str) -> Path:
        return self.path / _VIEWS / f"{name}.json"


def refuse_output(output: Path, overwrite: bool) -> None:
    """Look before anything is computed whether the scene can get its name. Raises ConfigError: the folder holds
    something; with `overwrite`, something that this command did not make."""
    if not output.resolve().name:
        raise ConfigError(f"{output} can't be a scene; give a folder of its own with --output-dir")
    if output.is_file():
        raise ConfigError(f"{output} is a file; give a folder with --output-dir")
    if not output.is_dir() or not any(output.iterdir()):
        return
    if not (output / RECORD_NAME).is_file():
        raise ConfigError(f"{output} is not empty; give a new folder with --output-dir")
    if not overwrite:
        raise ConfigError(f"{output} holds a scene already; replace it with --overwrite, or choose another")
    refuse_folder(output.resolve())


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True) + "\n").encode()


def fingerprint(plan: Plan, options: ProcessOptions, lenses: Mapping[str, Lens]) -> dict[str, Any]:
    """What must be the same for views to be used again: options, decisions, input files, and the lenses that pixels are
    brought into, by view. Raises CaptureError: a file can't be read."""
    free = [
        "output_dir",
        "overwrite",
        "poses",
        "marker_size",
        "marker_family",
        "known_distance",
        "angles",
        "field_of_view",
        "line_rate",
        "camera_axes",
    ]
    fixed = {key: value for key, value in plain_options(options).items() if key not in free}
    files = [path for view in plan.views for path in input_files(view)] + list(plan.option_files)
    stamps = []  # path, size and time of change, which tell quickly whether a file is still the same
    for file in _files_of(files):
        with reading(file):
            facts = file.stat()
        stamps.append([os.fspath(file.absolute()), facts.st_size, facts.st_mtime_ns])
    probe, of_lenses = np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.3], [-0.3, 0.2]]), []
    for lens in lenses.values():
        assert lens.resampled_from is not None
        seen = lens.resampled_from(probe).ravel().tolist()
        of_lenses.append([*lens.focal_px, *lens.center_px, *lens.distortion, *lens.higher_radial, *seen])
    # What transforms.json states may change while its poses, which views don't depend on, are mended.
    stated = [view.cube.linear for view in plan.views if view.cube.linear is not None]
    return {
        "version": __version__,
        "options": fixed,
        "plan": plan.numbers,
        "bands": {name: sensor.centers_nm.tolist() for name, sensor in plan.sensors.items()},
        "gains": sorted({repr((one.gains.tolist(), one.offsets.tolist())) for one in stated}),
        "files": stamps,
        "lenses": sorted(of_lenses),
    }


def input_files(view: CaptureView) -> list[Path]:
    """Every file that a view is made of."""
    more = [path for path in (view.picture, view.mask, view.labels) if path is not None]
    return [*view.cube.files, *more, *(path for file in view.references for path in file.files)]


def hashes(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Path, size and SHA-256 of each file. CaptureError where one can't be read."""
    found = []
    for file in _files_of(paths):
        with reading(file):
            found.append({"path": os.fspath(file), "bytes": file.stat().st_size, "sha256": hash_of(file)})
    return found


def _files_of(paths: Iterable[Path]) -> Iterator[Path]:
    """Files, and those of a folder that a reader takes as one."""
    for path in paths:
        yield from sorted(child for child in path.iterdir() if child.is_file()) if path.is_dir() else [path]
