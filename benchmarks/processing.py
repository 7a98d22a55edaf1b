"""How much memory and time do large captures take, and what is left of a start that is killed?

    python benchmarks/processing.py

Writes 100 cubes of 1000 x 1000 x 200 uint16 (40 GB, sparse but for the rows that the first pass looks at and for the
views that are timed), makes a scene of them with dark frame, white reference and a mask, kills the command after the
first views, starts it again, and kills it once more. Copying the same files is timed beside. Takes a few minutes and
some GB of disk.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import _common
import _machine
import numpy as np
import tyro

from unmix_plugin.captures.calibration.calibration import sampled_rows

PEAK_GB = _common.Limit(1.5, is_upper=True, unit=" GB")
RESUMED_VIEWS = 2
POLL_SECONDS = 0.05
HEADER = """ENVI
samples = {width}
lines = {lines}
bands = {bands}
header offset = 0
data type = 12
interleave = bil
byte order = 0
wavelength units = Nanometers
wavelength = {{{wavelengths}}}
"""


@dataclass(frozen=True)
class Options:
    """A scene from a large capture, killed and started again."""

    views: int = 100
    """Cubes of the capture."""
    timed: int = 4
    """Views that hold numbers everywhere; the first start is killed after them."""
    size: int = 1000
    """Rows and columns."""
    bands: int = 200
    """Of each cube."""
    results: Path | None = None
    """Folder for processing.json and processing.md; None: beside the benchmarks."""
    quick: bool = False
    """Twelve small cubes."""


@dataclass(frozen=True)
class Start:
    """What was seen of one start until it was killed."""

    first_view_s: float
    """Until the first view of this start was written."""
    per_view_s: float
    """Of the views after the first."""
    peak_gb: float
    """Resident memory, greatest."""


def main() -> None:
    """Write the capture, process it twice, copy it, report."""
    options = tyro.cli(Options)
    if options.quick:
        options = Options(12, 3, 60, 20, options.results, True)
    machine = _machine.describe_machine()
    with tempfile.TemporaryDirectory(prefix="processing-") as folder:
        root = Path(folder)
        _write_capture(root / "capture", options)
        first = _start(root, options.timed)
        copy_s = _copy(root, options.timed) / options.timed
        done = {
            path.name: path.stat().st_mtime_ns for path in (root / "scene.unfinished/views").glob("*.json")
        }
        second = _start(root, len(done) + RESUMED_VIEWS)
        kept = all(
            (root / "scene.unfinished/views" / name).stat().st_mtime_ns == at for name, at in done.items()
        )
        is_no_scene = (
            not (root / "scene").exists() and not (root / "scene.unfinished/transforms.json").exists()
        )
    _common.publish(
        _report(options, machine, first, second, copy_s, kept and is_no_scene),
        _common.results_folder(options.results, options.quick),
    )


def _write_capture(folder: Path, options: Options) -> None:
    """Cubes whose middle is bright and whose border is dark, with white, dark and poses."""
    folder.mkdir()
    size, bands = options.size, options.bands
    generator = np.random.default_rng(0)
    row_bytes = bands * size * 2
    texture = generator.integers(300, 2500, (64, bands, size), np.uint16)
    texture[..., : size // 5] = texture[..., -size // 5 :] = 102
    border = np.full((bands, size), 102, "<u2")
    for index in range(options.views):
        is_dense = index < options.timed
        with (folder / f"view_{index:03d}.raw").open("wb") as file:
            for row in range(size) if is_dense else sorted({0, size - 1, *sampled_rows(size)}):
                file.seek(row * row_bytes)
                is_border = not size // 5 <= row < size - size // 5
                file.write((border if is_border else texture[row % len(texture)]).tobytes())
            file.truncate(size * row_bytes)
        _write_header(folder / f"view_{index:03d}.hdr", size, options)
    for name, level in (("white", 3000), ("dark", 100)):
        np.full((20, bands, size), level, "<u2").tofile(folder / f"{name}.raw")
        _write_header(folder / f"{name}.hdr", 20, options)
    frames = [
        {"file_path": f"view_{index:03d}", "transform_matrix": _pose(2 * np.pi * index / options.views)}
        for index in range(options.views)
    ]
    content = {"w": size, "h": size, "fl_x": 1.5 * size, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def _write_header(path: Path, lines: int, options: Options) -> None:
    wavelengths = ", ".join(f"{value:.2f}" for value in np.linspace(400, 1000, options.bands))
    text = HEADER.format(width=options.size, lines=lines, bands=options.bands, wavelengths=wavelengths)
    path.write_text(text, encoding="utf-8")


def _pose(angle: float) -> list[list[float]]:
    """On a ring, looking at its middle."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[-s, 0.0, c, 3 * c], [c, 0.0, s, 3 * s], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def _start(root: Path, until: int) -> Start:
    """Start the command, and kill it when so many views are written."""
    command = [sys.executable, "-c", "from unmix_plugin.commands import scripts; scripts.process()", "cubes"]
    command += ["--data", str(root / "capture"), "--output-dir", str(root / "scene"), "--mask", "black"]
    command += ["--poses", "transforms.json", "--max-noise", "10"]
    command += ["--white", str(root / "capture/white.hdr"), "--dark", str(root / "capture/dark.hdr")]
    views = root / "scene.unfinished" / "views"
    before, started = _count(views), time.perf_counter()
    process = subprocess.Popen(command, cwd=_common.REPOSITORY, stdout=subprocess.DEVNULL)
    first, peak = None, 0.0
    try:
        while (found := _count(views)) < until:
            if process.poll() is not None:
                raise SystemExit(
                    f"unmix-process ended with {process.returncode} before {until} views were written"
                )
            if first is None and found > before:
                first = time.perf_counter()
            peak = max(peak, _peak_gb(process.pid))
            time.sleep(POLL_SECONDS)
        ended = time.perf_counter()
        peak = max(peak, _peak_gb(process.pid))
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    first = ended if first is None else first
    return Start(first - started, (ended - first) / max(1, until - before - 1), peak)


def _count(folder: Path) -> int:
    return len(list(folder.glob("*.json")))


def _peak_gb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next((int(line.split()[1]) * 1024 / 1e9 for line in lines if line.startswith("VmHWM")), 0.0)


def _copy(root: Path, count: int) -> float:
    """Seconds to copy the first cubes and force them to disk, as is done with written cubes."""
    started = time.perf_counter()
    for index in range(count):
        target = root / "copy.raw"
        shutil.copyfile(root / "capture" / f"view_{index:03d}.raw", target)
        with target.open("rb") as file:
            os.fsync(file.fileno())
    return time.perf_counter() - started


def _report(
    options: Options, machine: dict, first: Start, second: Start, copy_s: float, is_resumed: bool
) -> _common.Report:
    megabytes = options.size**2 * options.bands * 2 / 1e6
    return _common.Report(
        name="processing",
        question="How much memory and time do large captures take, and what is left of a start that is killed?",
        setting={
            "cubes": f"{options.views} of {options.size} x {options.size} x {options.bands} uint16, ENVI bil",
            "timed_views": options.timed,
            "steps": "dark frame, white reference, black background, pictures, SHA-256 of every input",
        },
        machine=machine,
        figures=[
            PEAK_GB.judge("peak memory, first start", first.peak_gb),
            PEAK_GB.judge("peak memory, second start", second.peak_gb),
            _common.required(
                "killed and started again: done views are kept, nothing looks like a scene",
                "yes",
                is_resumed,
                "yes" if is_resumed else "no",
            ),
            _common.reported("start until the first view is written", f"{first.first_view_s:.1f} s"),
            _common.reported("second start until its first view is written", f"{second.first_view_s:.1f} s"),
            _common.reported("a view", f"{first.per_view_s:.1f} s ({megabytes / first.per_view_s:.0f} MB/s)"),
            _common.reported("copying its file", f"{copy_s:.1f} s ({megabytes / copy_s:.0f} MB/s)"),
        ],
        measured={"first": vars(first), "second": vars(second), "copy_s": copy_s, "megabytes": megabytes},
    )


if __name__ == "__main__":
    main()
