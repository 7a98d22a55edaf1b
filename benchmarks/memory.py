"""Does a training keep to the memory that it was given, and how soon does it take its first step?

    python benchmarks/memory.py

Writes 40 views of 1000 x 1000 pixels in 100 bands without alpha as integers of 16 bits (8 GB, all on the disk), and
trains on them by the command that a user would give, with 2 GiB for the training pixels, which are kept as components,
and with 0.3 GiB, for which they stay on disk. Watched from outside: the largest anonymous memory, which is what can't
be given back, and the time from the command to its first step. Takes about five minutes and 8 GB of disk.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import nullcontext
from dataclasses import dataclass
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
    memory_gb: tuple[float, ...] = (2.0, 0.3)
    """For the training pixels, GiB: a training each."""
    alpha: bool = False
    """A scene with alpha instead, most of it black."""
    scene: Path | None = None
    """The scene; written where it is not there."""
    results: Path | None = None
    """Folder for memory.json and memory.md; None: beside the benchmarks."""
    quick: bool = False
    """A small scene and few steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine()
    size, views, steps = (200, 6, 5) if options.quick else (options.size, options.views, options.steps)
    context = nullcontext("") if options.scene else tempfile.TemporaryDirectory(prefix="unmix-memory-")
    with context as name, tempfile.TemporaryDirectory(prefix="unmix-memory-") as work:
        scene = options.scene or Path(name) / "scene"
        if not scene.exists():
            (write_large_scene if options.alpha else write_dense_scene)(scene, size, options.bands, views)
        measured = [watched(scene, memory, steps, Path(work) / f"{memory:g}") for memory in options.memory_gb]
    kind = "with alpha, float16" if options.alpha else "without alpha, uint16"
    setting = {
        "scene": f"{views} views x {size} x {size} pixels x {options.bands} bands x 2 bytes, {kind}",
        "steps": steps,
    }
    report = _common.Report(
        "memory",
        "Memory while a large scene is read and trained on",
        setting,
        machine,
        judge(measured),
        measured,
        variant="alpha" if options.alpha else "",
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def watched(scene: Path, memory_gb: float, steps: int, work: Path) -> dict[str, Any]:
    """A training, watched until it ends."""
    words = [
        _common.console_script("unmix-train"),
        "unmix-nerf",
        "--data",
        str(scene),
        "--output-dir",
        str(work),
    ]
    words += ["--device", "cpu", "--pipeline.datamanager.memory-gb", str(memory_gb)]
    words += ["--max-num-iterations", str(steps), "--steps-per-log", "1"]
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
    if process.returncode != 0:
        raise SystemExit(f"unmix-train ended with {process.returncode}:\n{output[-2000:]}")
    notes = [line for line in output.splitlines() if "training pixels" in line or "numbers instead" in line]
    return {
        "memory_gb": memory_gb,
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
    """What is asked of the first training, and what the others did."""
    figures = []
    for index, found in enumerate(measured):
        given = f"memory-gb {found['memory_gb']:g}"
        if index == 0:
            figures.append(PEAK.judge(f"peak of anonymous memory, {given}", found["peak_gb"]))
            figures.append(FIRST_STEP.judge(f"time to the first step, {given}", found["first_step_seconds"]))
            continue
        figures.append(_common.reported(f"peak of anonymous memory, {given}", f"{found['peak_gb']:.3g} GB"))
        figures.append(
            _common.reported(f"time to the first step, {given}", f"{found['first_step_seconds']:.3g} s")
        )
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
