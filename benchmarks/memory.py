"""Does a training keep to the memory that it was given, and how soon does it take its first step?

    python benchmarks/memory.py

Writes scenes of 40 views of 1000 x 1000 pixels in 100 bands (8 GB each, one at a time) and trains on them by the
command that a user would give, with 2 GiB for the training pixels: a room and an open world without alpha, a table
before a black backdrop, a table with alpha, a room by two sensors, and the room with poses that are refined; and the
room with 0.3 GiB, for which its pixels stay on disk. Watched from outside: the largest anonymous memory, which is what
can't be given back, and the time from the command to its first step. Takes about fifteen minutes and 8 GB of disk.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import _common
import _machine
import tyro
from _large_scene import write_dense_scene, write_large_scene

PEAK = _common.Limit(3.0, is_upper=True, unit=" GB")
FIRST_STEP = _common.Limit(40.0, is_upper=True, unit=" s")
POLL_SECONDS = 0.02


@dataclass(frozen=True)
class Training:
    """A scene, and how it is trained on."""

    scene: str
    """As `write_dense_scene` calls it, or alpha."""
    memory_gb: float = 2.0
    """For the training pixels, GiB."""
    words: tuple[str, ...] = ()
    """Further words of the command."""


PATHS = {
    "room": Training("room"),
    "room, little memory": Training("room", 0.3),
    "refined poses": Training("room", words=("--poses", "refine")),
    "backdrop": Training("backdrop"),
    "unbounded": Training("world"),
    "rig": Training("rig"),
    "alpha": Training("alpha"),
}


@dataclass(frozen=True)
class Options:
    """Peak of anonymous memory and time to the first step."""

    size: int = 1000
    """Width and height of a view, pixels; a multiple of 4."""
    bands: int = 100
    """Of the scene."""
    views: int = 40
    """Of the scene."""
    steps: int = 60
    """Training steps, until memory has reached its peak."""
    paths: tuple[str, ...] = tuple(PATHS)
    """Which trainings."""
    work: Path | None = None
    """Folder for the scenes, which are removed again; None: a temporary one."""
    results: Path | None = None
    """Folder for memory.json and memory.md; None: beside the benchmarks."""
    quick: bool = False
    """A small scene and few steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine()
    size, views, steps = (200, 6, 5) if options.quick else (options.size, options.views, options.steps)
    measured = []
    with tempfile.TemporaryDirectory(prefix="unmix-memory-", dir=options.work) as name:
        by_scene = sorted(options.paths, key=lambda path: list(PATHS).index(path))
        for kind, paths in groupby(by_scene, key=lambda path: PATHS[path].scene):
            scene = Path(name) / kind
            if kind == "alpha":
                write_large_scene(scene, size, options.bands, views)
            else:
                write_dense_scene(scene, size, options.bands, views, kind)
            measured += [
                {"path": path, **watched(scene, PATHS[path], steps, Path(name) / "runs")} for path in paths
            ]
            shutil.rmtree(scene)
    setting = {
        "scenes": f"{views} views x {size} x {size} pixels x {options.bands} bands x 2 bytes",
        "steps": steps,
    }
    report = _common.Report(
        "memory",
        "Memory while large scenes are read and trained on",
        setting,
        machine,
        judge(measured),
        measured,
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def watched(scene: Path, training: Training, steps: int, work: Path) -> dict[str, Any]:
    """A training, watched until it ends; nothing is left of it."""
    words = [
        _common.console_script("unmix-train"),
        "unmix-nerf",
        "--data",
        str(scene),
        "--output-dir",
        str(work),
    ]
    words += ["--device", "cpu", "--pipeline.datamanager.memory-gb", str(training.memory_gb)]
    words += ["--max-num-iterations", str(steps), "--steps-per-log", "1", *training.words]
    peak = peak_before = first_step = 0.0
    with tempfile.TemporaryFile() as log:
        began = time.perf_counter()
        process = _common.start(words, log)
        while process.poll() is None:
            peak = max(peak, anonymous_bytes(process.pid))
            if not first_step and any(path.stat().st_size for path in work.glob("*/*/*/metrics.jsonl")):
                first_step, peak_before = time.perf_counter() - began, peak
            time.sleep(POLL_SECONDS)
        log.seek(0)
        output = log.read().decode(errors="replace")
    shutil.rmtree(work, ignore_errors=True)
    if process.returncode != 0:
        raise SystemExit(f"unmix-train ended with {process.returncode}:\n{output[-2000:]}")
    notes = [line for line in output.splitlines() if "training pixels" in line or "numbers instead" in line]
    return {
        "memory_gb": training.memory_gb,
        "peak_gb": peak / 1e9,
        "peak_before_first_step_gb": peak_before / 1e9,
        "first_step_seconds": first_step,
        "seconds": time.perf_counter() - began,
        "notes": notes,
    }


def anonymous_bytes(pid: int) -> int:
    """What a process holds that lies in no file."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon:")), 0)


def judge(measured: list[dict[str, Any]]) -> list[_common.Figure]:
    """What is asked of every path, and how soon the first begins."""
    figures = [
        PEAK.judge(f"peak of anonymous memory, {found['path']}", found["peak_gb"]) for found in measured
    ]
    first, *others = measured
    figures.append(FIRST_STEP.judge(f"time to the first step, {first['path']}", first["first_step_seconds"]))
    for found in others:
        what = f"time to the first step, {found['path']}"
        figures.append(_common.reported(what, f"{found['first_step_seconds']:.3g} s"))
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
