"""Where does the time of a training step go, and that of a frame and of a start?

    python benchmarks/step_profile.py [--only object room] [--steps 60]

Trains for a while on an object, a closed room, large pictures and many bands, with all defaults, and times the parts of
the steps that follow, in processor seconds of the threads that call them. Then a few steps are recorded operation by
operation: how many tensor operations a step has, which take longest, how much memory they ask for, and how long the
main thread is in none, which is Python's part. A frame of 512 rows is timed, and the first step after the command.
Exports, pages and captures have benchmarks of their own (export_speed, page, processing). About six minutes on two
quiet cores.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import _common
import _machine
import torch
import tyro
from torch.profiler import ProfilerActivity, profile

from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.scenes.demo.scene import make_demo_scene

BUSY = _common.Limit(1.75, unit=" cores")
OPERATIONS = _common.Limit(1200, is_upper=True)
START = _common.Limit(4.0, is_upper=True, unit=" s")
WRITTEN = {"512 x 512": (512, 31, 24), "128 bands": (96, 128, 32)}
"""Built-in scenes: pixels along an edge, bands, views."""
RENDERED = {"object": "table", "room": "room"}
"""Path-traced scenes."""
_FRAME_ROWS, _RECORDED, _MOST_LISTED = 512, 10, 12
_FIRST_STEP = """
import os, sys
import unmix_plugin.commands.scripts  # with what it sets for all commands
from unmix_plugin.commands.train import parse
from unmix_plugin.engine.training.steps import prepare_steps
steps = prepare_steps(parse(sys.argv[1:])[0])[1]
steps.pipeline.model.warm_up()
steps.begin(0)
steps.take(0, 0.0)
os._exit(0)  # what a process takes to end is no part of it
"""


@dataclass(frozen=True)
class Options:
    """Profile trainings."""

    only: tuple[str, ...] = ()
    """Of object, room, 512 x 512, 128 bands; all if none is given."""
    before: int = 300
    """Steps before the first that is timed."""
    steps: int = 60
    """That are timed."""
    results: Path | None = None
    """Folder for step_profile.json and step_profile.md; None: beside the benchmarks."""
    quick: bool = False
    """A few steps on a small scene."""


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine()
    names = options.only or (*RENDERED, *WRITTEN)
    before, count = (3, 3) if options.quick else (options.before, options.steps)
    with tempfile.TemporaryDirectory(prefix="unmix-profile-") as folder:
        scenes = {name: _common.cached_scene(RENDERED[name]) for name in names if name in RENDERED}
        if options.quick:
            names, scenes = ("small",), {"small": Path(folder) / "small"}
            make_demo_scene(scenes["small"], 32, 8, 8)
        _common.require_scenes(*scenes.values())
        for name in names:
            if name not in scenes:
                scenes[name] = Path(folder) / name.replace(" ", "-")
                size, bands, views = WRITTEN[name]
                make_demo_scene(scenes[name], size, bands, views)
        measured = {}
        for name in names:
            words = ["unmix-nerf", "--data", str(scenes[name]), "--device", "cpu"]
            trainer = _common.quiet_trainer(
                [*words, "--output-dir", f"{folder}/runs", "--max-num-iterations", "3000"]
            )
            measured[name] = profiled(trainer, before, count)
            if name in ("object", "small"):
                measured[name] |= {"frame": frame_seconds(trainer), "start": start_seconds(words)}
            print(name, measured[name]["step"], flush=True)
    setting = {"steps before": before, "steps timed": count, "threads": torch.get_num_threads()}
    report = _common.Report(
        "step_profile", "Where the time goes", setting, machine, judge(measured), measured, tables(measured)
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


class Clock:
    """Adds up what calls take of the processor, in seconds of the threads that call."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._adding = Lock()

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The same call, timed."""

        def run(*args: Any, **kwargs: Any) -> Any:
            began = time.thread_time()
            try:
                return call(*args, **kwargs)
            finally:
                with self._adding:
                    self.spent[part] += time.thread_time() - began

        return run


def profiled(trainer: Trainer, before: int, count: int) -> dict[str, Any]:
    """Seconds a step by part, and the operations of a step."""
    total = 3000
    _common.take_steps(trainer, range(before), total)
    clock, began = Clock(), (time.perf_counter(), time.process_time())
    rays = timed_steps(trainer, clock, range(before, before + count), total)
    wall, processor = time.perf_counter() - began[0], time.process_time() - began[1]
    parts = {part: 1000 * spent / count for part, spent in clock.spent.items()}
    parts["the rest, and other threads"] = 1000 * processor / count - sum(parts.values())
    return {
        "step": {
            "wall ms": 1000 * wall / count,
            "processor ms": 1000 * processor / count,
            "cores": processor / wall,
            "rays per wall second": rays / wall,
            "rays per processor second": rays / processor,
        },
        "parts": parts,
        **recorded(trainer, range(before + count, before + count + _RECORDED), total),
    }


def timed_steps(trainer: Trainer, clock: Clock, numbers: range, total: int) -> int:
    """Take steps with their parts timed, in whichever thread they run; rays of all."""
    steps, pipeline, model = trainer.steps, trainer.pipeline, trainer.pipeline.model
    plain = [
        (type(pipeline.datamanager), "next_train", "batch"),
        (type(model), "between_steps", "grid and guide, between steps"),
        (type(model), "training_batch", "rays rendered and compared"),
        (type(model), "losses", "losses"),
        (type(model), "update", "what is learnt from a step without gradients"),
        (torch.Tensor, "backward", "backward"),
        (steps.optimizer, "step", "optimiser"),
        *([] if trainer.average is None else [(trainer.average, "update", "averages of parameters")]),
    ]
    kept = [(owner, name, getattr(owner, name)) for owner, name, _ in plain]
    for owner, name, part in plain:
        setattr(owner, name, clock.timed(part, getattr(owner, name)))
    try:
        return _common.take_steps(trainer, numbers, total)
    finally:
        for owner, name, call in kept:
            setattr(owner, name, call)


def recorded(trainer: Trainer, numbers: range, total: int) -> dict[str, Any]:
    """Operations of a step by the profiler of PyTorch, which itself takes time."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        began = time.perf_counter()
        _common.take_steps(trainer, numbers, total)
        wall = time.perf_counter() - began
    events = record.events()
    assert events is not None
    main_thread = statistics.mode(event.thread for event in events if event.name.startswith("aten::"))
    outer = [event for event in events if event.cpu_parent is None]
    in_operations = sum(event.cpu_time_total for event in outer if event.thread == main_thread) / 1e6
    averages = sorted(record.key_averages(), key=lambda one: -one.self_cpu_time_total)
    asked = sum(max(0, one.self_cpu_memory_usage) for one in averages)
    return {
        "operations": len(outer) / _RECORDED,
        "operations with those within": len(events) / _RECORDED,
        "python share": max(0.0, 1 - in_operations / wall),
        "MB asked for": asked / _RECORDED / 1e6,
        "longest": {
            one.key: [one.count / _RECORDED, one.self_cpu_time_total / _RECORDED / 1e3]
            for one in averages[:_MOST_LISTED]
        },
    }


def frame_seconds(trainer: Trainer) -> dict[str, float]:
    """Of a frame of 512 rows, the median of three."""
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    camera, _ = manager.eval_image(0)
    width = round(_FRAME_ROWS * camera.width / camera.height)
    model.eval()
    found = []
    with _common.averaged(trainer):
        for _ in range(3):
            began = time.perf_counter(), time.process_time()
            model.get_outputs_for_camera(camera.resized(width, _FRAME_ROWS))
            found.append((time.perf_counter() - began[0], time.process_time() - began[1]))
    return {
        "wall s": statistics.median(a for a, _ in found),
        "processor s": statistics.median(b for _, b in found),
    }


def start_seconds(words: list[str]) -> dict[str, float]:
    """From a new process to the end of its first step, when kernels and, as after an installation, all modules are
    compiled: on a scene that was never judged, and once more when what was judged of it is kept."""
    found = {}
    with tempfile.TemporaryDirectory(prefix="unmix-modules-") as folder:
        own = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        own |= {"PYTHONPYCACHEPREFIX": f"{folder}/modules", "XDG_CACHE_HOME": f"{folder}/cache"}
        for name in ("compiling ", "", "again "):
            if not name:
                shutil.rmtree(f"{folder}/cache/unmix-nerf/judged")
            began, before = time.perf_counter(), os.times()
            command = [sys.executable, "-c", _FIRST_STEP, *words]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=own)
            after = os.times()
            spent = (
                after.children_user + after.children_system - before.children_user - before.children_system
            )
            found |= {f"{name}wall s": time.perf_counter() - began, f"{name}processor s": spent}
    return found


def judge(measured: dict[str, Any]) -> list[_common.Figure]:
    """What is asked."""
    figures = []
    for name, one in measured.items():
        figures.append(BUSY.judge(f"{name}: cores that are busy", one["step"]["cores"]))
        figures.append(OPERATIONS.judge(f"{name}: tensor operations a step", one["operations"]))
        figures.append(_common.reported(f"{name}: Python's share", f"{one['python share']:.0%}"))
        if "start" in one:
            figures.append(START.judge(f"{name}: first step after the command, wall", one["start"]["wall s"]))
            spent = one["start"]["processor s"]
            figures.append(_common.reported(f"{name}: the same, processor time", f"{spent:.1f} s"))
            again = one["start"]["again wall s"]
            figures.append(START.judge(f"{name}: first step of a second command, wall", again))
            figures.append(
                _common.reported(
                    f"{name}: a frame of 512 rows after these steps, wall", f"{one['frame']['wall s']:.2f} s"
                )
            )
    return figures


def tables(measured: dict[str, Any]) -> tuple[_common.DetailTable, ...]:
    """Steps, their parts, and operations."""
    steps = [
        [name, *(f"{value:.4g}" for value in one["step"].values()), f"{one['operations with those within']:.0f}",
         f"{one['MB asked for']:.0f}"]
        for name, one in measured.items()
    ]  # fmt: skip
    parts = [
        [name, part, f"{processor:.2f}"]
        for name, one in measured.items()
        for part, processor in one["parts"].items()
    ]
    longest = [
        [name, operation, f"{count:.0f}", f"{ms:.2f}"]
        for name, one in measured.items()
        for operation, (count, ms) in one["longest"].items()
    ]
    first = next(iter(measured.values()))["step"]
    return (
        _common.DetailTable(
            "a step", ["scene", *first, "operations with those within", "MB asked for"], steps
        ),
        _common.DetailTable("parts of a step, processor ms", ["scene", "part", "ms"], parts),
        _common.DetailTable("longest operations", ["scene", "operation", "a step", "own ms a step"], longest),
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
