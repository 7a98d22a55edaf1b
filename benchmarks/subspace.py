"""What do training pixels cost that are kept as components of a subspace, and what do they save?

    python benchmarks/subspace.py

Trains twice on the built-in scene in 200 bands, with the same draws and as many steps: once with all bands of each
training pixel in memory, and once with a third of the memory for them, so that `target-components` finds a subspace.
The steps of both are taken in turn, so that a busy machine slows both. Takes about four minutes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import _common
import _machine
import tyro

from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.scenes.demo.scene import make_demo_scene

PSNR_DIFFERENCE = _common.Limit(0.05, is_upper=True, unit=" dB")
STEP_RATIO = _common.Limit(1.05, is_upper=True)
MEMORY_RATIO = _common.Limit(0.34, is_upper=True)
UNTIMED_STEPS = 20
_GIB = 2**30


@dataclass(frozen=True)
class Options:
    """All bands of each training pixel beside its components."""

    bands: int = 200
    """Of the scene."""
    size: int = 96
    """Width and height of the scene's images, pixels."""
    views: int = 32
    """The scene's images."""
    steps: int = 500
    """Training steps of both."""
    results: Path | None = None
    """Folder for subspace.json and subspace.md; None: beside the benchmarks."""
    quick: bool = False
    """A small scene and few steps."""


def main(options: Options) -> None:
    """Train, evaluate, publish."""
    machine = _machine.describe_machine()
    size, views, steps = (80, 12, 30) if options.quick else (options.size, options.views, options.steps)
    with TemporaryDirectory(prefix="unmix-subspace-") as name:
        folder = Path(name)
        make_demo_scene(folder / "scene", size, options.bands, views)
        whole = prepared(folder, steps, "4")
        needed = held_bytes(whole)
        trainers = {
            "all bands": whole,
            "components": prepared(folder, steps, str(max(0.01, needed / 3 / _GIB))),
        }
        notes = manager_of(trainers["components"]).warnings()
        seconds = train_in_turn(list(trainers.values()), steps)
        measured = {
            name: {
                "psnr": _common.evaluated_psnr(trainer),
                "step_cpu_ms": 1e3 * median(taken),
                "pixel_mb": held_bytes(trainer) / 1e6,
            }
            for (name, trainer), taken in zip(trainers.items(), seconds, strict=True)
        }
    setting = {
        "scene": f"built-in, {size} x {size} pixels, {views} views, {options.bands} bands",
        "steps": steps,
        "found": notes,
    }
    question = f"Training pixels of {options.bands} bands: components beside all bands"
    report = _common.Report(
        "subspace", question, setting, machine, judge(measured), measured, (table(measured),)
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def prepared(folder: Path, steps: int, memory_gb: str) -> Trainer:
    """A trainer that holds its training pixels in so much memory."""
    words = ["unmix-nerf", "--data", str(folder / "scene"), "--output-dir", str(folder / f"runs-{memory_gb}")]
    words += ["--max-num-iterations", str(steps), "--device", "cpu"]
    words += ["--pipeline.datamanager.memory-gb", memory_gb]
    return _common.quiet_trainer(words)


def manager_of(trainer: Trainer) -> HyperspectralDataManager:
    """What serves the pixels."""
    manager = trainer.pipeline.datamanager
    assert isinstance(manager, HyperspectralDataManager)
    return manager


def held_bytes(trainer: Trainer) -> int:
    """Memory that the spectra of the training pixels take."""
    return sum(block.held_bytes for block in manager_of(trainer)._pixels.blocks)


def train_in_turn(trainers: list[Trainer], steps: int) -> list[list[float]]:
    """Train all, a step of each after the other; processor seconds of the steps of each."""
    seconds: list[list[float]] = [[] for _ in trainers]
    for step in range(steps):
        for trainer, taken in zip(trainers, seconds, strict=True):
            began = time.process_time()
            _common.take_steps(trainer, [step], steps)
            taken.append(time.process_time() - began)
    return [taken[UNTIMED_STEPS:] for taken in seconds]


def judge(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """Components beside all bands."""
    one, other = measured["all bands"], measured["components"]
    return [
        PSNR_DIFFERENCE.judge("PSNR, lost by components", one["psnr"] - other["psnr"]),
        MEMORY_RATIO.judge("memory for spectra, ratio", other["pixel_mb"] / one["pixel_mb"]),
        STEP_RATIO.judge(
            "processor time of a step, ratio of medians", other["step_cpu_ms"] / one["step_cpu_ms"]
        ),
    ]


def table(measured: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """Every number."""
    headers = ("training pixels", "PSNR, dB", "spectra in memory, MB", "processor time of a step, ms")
    rows = [
        (name, f"{found['psnr']:.3f}", f"{found['pixel_mb']:.1f}", f"{found['step_cpu_ms']:.1f}")
        for name, found in measured.items()
    ]
    return _common.DetailTable("Both trainings", headers, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
