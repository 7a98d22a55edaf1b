"""Does a scene larger than memory train as fast as one that is held, in little memory, and does it resume exactly?

    python benchmarks/store.py

Writes 100 views of 1000 x 1000 pixels in 200 bands (40 GB, of which less than 3 GB lie on the disk: black places are
holes), prepares a training on them that reads pixels from disk, and one on the first views of the same scene whose
pixels are held. The steps of both are taken in turn, so that a busy machine slows both. Then a small scene is trained
from disk by the commands that a user would give, once straight and once killed and resumed. Takes about ten minutes,
most of them for reading 40 GB several times.
"""

from __future__ import annotations

import resource
import signal
import tempfile
import time
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import torch
import tyro
from _large_scene import few_views, write_large_scene

from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.scenes.demo.scene import make_demo_scene

PEAK_MEMORY = _common.Limit(4.0, is_upper=True, unit=" GB")
RATE = _common.Limit(0.8)
WARM_UP_STEPS = 60
"""Until the budget of samples has found its rays, and the peak of memory is behind."""
POLL_SECONDS = 0.02


@dataclass(frozen=True)
class Options:
    """A scene on disk beside one in memory, and a run from disk that is killed."""

    size: int = 1000
    """Width and height of a view, pixels."""
    bands: int = 200
    """Of the scene."""
    views: int = 100
    """On disk."""
    held_views: int = 8
    """Of the scene that is held."""
    steps: int = 200
    """Steps that are timed."""
    scene: Path | None = None
    """The large scene, where it was written before by `_large_scene.py`."""
    results: Path | None = None
    """Folder for store.json and store.md; None: beside the benchmarks."""
    quick: bool = False
    """A small scene and few steps."""


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine()
    size, views, steps = (200, 6, 20) if options.quick else (options.size, options.views, options.steps)
    context = nullcontext("") if options.scene else tempfile.TemporaryDirectory(prefix="unmix-store-")
    with context as name, tempfile.TemporaryDirectory(prefix="unmix-store-", dir=name or None) as work:
        large = options.scene or Path(name) / "large"
        if options.scene is None:
            print(f"writing {2 * views * size**2 * options.bands / 1e9:.3g} GB ...", flush=True)
            write_large_scene(large, size, options.bands, views)
        few_views(large.parent / "few", large, min(views, options.held_views))
        measured = rates(large, large.parent / "few", Path(work), steps)
        measured["resumed"] = resumed(Path(work), 12 if options.quick else 60)
    setting = {
        "scene": f"{views} views x {size} x {size} pixels x {options.bands} bands x 2 bytes, sparse on disk",
        "held": f"the first {min(views, options.held_views)} views of it",
        "steps timed": steps,
    }
    report = _common.Report(
        "store", "Training pixels on disk beside such in memory", setting, machine, judge(measured), measured
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def rates(large: Path, few: Path, work: Path, steps: int) -> dict[str, Any]:
    """Peak of memory with the scene on disk, and rays a second of both."""
    began = time.process_time(), time.perf_counter()
    on_disk = prepared(large, work, "0.1" if steps < WARM_UP_STEPS else "1")
    read = time.process_time() - began[0], time.perf_counter() - began[1]
    for step in range(WARM_UP_STEPS):
        on_disk.steps.take(step, 0.5)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    held = prepared(few, work, "16")
    for step in range(WARM_UP_STEPS):
        held.steps.take(step, 0.5)
    found = {"on disk": [0.0, 0.0, 0.0], "held": [0.0, 0.0, 0.0]}
    for step in range(WARM_UP_STEPS, WARM_UP_STEPS + steps):
        for trainer, sums in ((on_disk, found["on disk"]), (held, found["held"])):
            cpu, wall = time.process_time(), time.perf_counter()
            rays = trainer.steps.take(step, 0.5).num_rays
            taken = (rays, time.process_time() - cpu, time.perf_counter() - wall)
            sums[:] = [before + new for before, new in zip(sums, taken, strict=True)]
    return {
        "notes": on_disk.pipeline.datamanager.warnings(),
        "peak_gb": peak / 1e9,
        "reading_cpu_seconds": read[0],
        "reading_wall_seconds": read[1],
        "rays_per_cpu_second": {name: rays / cpu for name, (rays, cpu, _) in found.items()},
        "rays_per_second": {name: rays / wall for name, (rays, _, wall) in found.items()},
    }


def prepared(scene: Path, work: Path, memory_gb: str) -> Trainer:
    """A trainer that is ready for its first step."""
    print(f"reading {scene.name} ...", flush=True)
    words = ["unmix-nerf", "--data", str(scene), "--output-dir", str(work / "runs"), "--device", "cpu"]
    words += ["--pipeline.datamanager.memory-gb", memory_gb, "--max-num-iterations", "10000"]
    words += ["--pipeline.datamanager.target-components", "none"]
    trainer = _common.quiet_trainer(words)
    trainer.pipeline.model.warm_up()
    trainer.steps.begin(0)
    return trainer


def resumed(work: Path, steps: int) -> dict[str, Any]:
    """Tensors of a straight run from disk, and how many of them differ after a kill and a resumption."""
    make_demo_scene(work / "demo", size=96, bands=31, views=32)
    words = [_common.console_script("unmix-train"), "unmix-nerf", "--data", str(work / "demo")]
    words += ["--max-num-iterations", str(steps), "--steps-per-save", str(steps // 3), "--device", "cpu"]
    words += ["--pipeline.datamanager.memory-gb", "0.01", "--output-dir"]
    straight = _common.run_command([*words, str(work / "straight")])
    with tempfile.TemporaryFile() as log:
        process = _common.start([*words, str(work / "killed")], log)
        while process.poll() is None and not list(work.glob("killed/*/*/*/checkpoints/*.json")):
            time.sleep(POLL_SECONDS)
        process.send_signal(signal.SIGKILL)
        process.wait()
    [run] = work.glob("killed/*/*/*")
    killed_at = newest_complete_checkpoint(run / "checkpoints")
    _common.run_command([_common.console_script("unmix-train"), "unmix-nerf", "--load-run", str(run)])
    ends = [newest_complete_checkpoint(path / "checkpoints") for path in (straight.run, run)]
    one, other = ends[0].tensors, ends[1].tensors
    return {
        "on disk": "stay on disk" in straight.output,
        "killed_at": killed_at.record["steps"],
        "ended_at": [end.record["steps"] for end in ends],
        "tensors": len(one),
        "different": sum(not torch.equal(one[name], other[name]) for name in one),
    }


def judge(measured: dict[str, Any]) -> list[_common.Figure]:
    """What is asked of large scenes."""
    resumption, fast, wall = (
        measured["resumed"],
        measured["rays_per_cpu_second"],
        measured["rays_per_second"],
    )
    steps = " and ".join(map(str, resumption["ended_at"]))
    return [
        PEAK_MEMORY.judge("peak memory while reading and training", measured["peak_gb"]),
        RATE.judge(
            "rays a processor second, pixels on disk / pixels in memory", fast["on disk"] / fast["held"]
        ),
        RATE.judge("rays a second, pixels on disk / pixels in memory", wall["on disk"] / wall["held"]),
        _common.required(
            "killed and resumed from disk",
            "equal to the bit",
            resumption["on disk"] and resumption["different"] == 0 and len(set(resumption["ended_at"])) == 1,
            f"{resumption['different']} of {resumption['tensors']} tensors differ; killed after step "
            f"{resumption['killed_at']}, ended after {steps}",
        ),
        _common.reported("rays a second on disk", f"{wall['on disk']:,.0f}"),
        _common.reported(
            "checking and reading the scene before training",
            f"{measured['reading_cpu_seconds']:.0f} s of processor time",
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
