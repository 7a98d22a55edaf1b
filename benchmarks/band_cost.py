"""What does a training step of 128 bands cost beside one of 3 bands?

    python benchmarks/band_cost.py

Writes the built-in scene twice, in 128 and in 3 bands, trains on the first for a while, and then measures steps
(forward, backward, optimiser) on both in turn. Before each pair of steps the second model takes the field and the
occupancy grid of the first, so both cast the same rays and take the same samples. Updates of the grid are left out:
they cost the same whatever the bands and would only make the ratio look better. Steps may differ with the progress of
training (how many rays go through a pixel), so they are measured as they are at its start and at its end. Takes about
two minutes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Literal

import _common
import _machine
import torch
import tyro

from unmix_plugin.engine.model import TrainingCallbackLocation
from unmix_plugin.engine.training.batches import work_on_batches
from unmix_plugin.engine.training.steps import run_callbacks
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.model import UnmixModel
from unmix_plugin.scenes.demo.scene import make_demo_scene

RATIO = _common.Limit(1.3, 1.1, is_upper=True)
UNTIMED_STEPS = 5
PHASES = {"start": 0.0, "end": 1.0}
"""Progress of training whose steps are measured."""


@dataclass(frozen=True)
class Options:
    """One training step at many bands beside one at few bands of the same scene."""

    bands: tuple[int, int] = (128, 3)
    """Many and few."""
    num_endmembers: int = 3
    """Of both models, so that bands are all they differ in; no more than the few bands."""
    size: int = 96
    """Width and height of the scene's images, pixels."""
    views: int = 32
    """The scene's images."""
    warm_up_steps: int = 300
    """Training steps before the measurement, so that the field is no longer an untrained one."""
    steps: int = 100
    """Pairs of steps to measure in each phase."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    results: Path | None = None
    """Folder for band_cost.json and band_cost.md; None: beside the benchmarks."""
    quick: bool = False
    """A small scene and few steps."""


@dataclass(frozen=True)
class StepCost:
    """What one training step took."""

    wall_seconds: float
    cpu_seconds: float
    """Of all threads."""
    num_rays: int
    num_samples: int


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine(options.device)
    size, views, warm_up_steps, steps = options.size, options.views, options.warm_up_steps, options.steps
    if options.quick:
        size, views, warm_up_steps, steps = 32, 8, 20, 5
    with TemporaryDirectory(prefix="unmix-band-cost-") as folder:
        trainers = prepare(options, Path(folder), size, views, warm_up_steps)
        phases = {
            name: [summarise(found) for found in measure(trainers, warm_up_steps, steps, progress)]
            for name, progress in PHASES.items()
        }
    setting = {
        "scene": f"built-in, {size} x {size} pixels, {views} views",
        "bands": list(options.bands),
        "num_endmembers": options.num_endmembers,
        "device": options.device,
        "threads": torch.get_num_threads(),
        "training steps before": warm_up_steps,
        "pairs of steps measured in each phase": steps,
    }
    named = {
        f"{phase} of training, {bands} bands": found
        for phase, pair in phases.items()
        for bands, found in zip(options.bands, pair, strict=True)
    }
    figures = [figure for phase, pair in phases.items() for figure in judge(phase, *pair)]
    question = f"One training step: {options.bands[0]} bands / {options.bands[1]} bands"
    report = _common.Report("band_cost", question, setting, machine, figures, named, (table(named),))
    _common.publish(report, _common.results_folder(options.results, options.quick))


def prepare(
    options: Options, folder: Path, size: int, views: int, warm_up_steps: int
) -> tuple[Trainer, Trainer]:
    """A trainer of many bands that has trained, and one of few bands that casts as many rays."""
    trainers = []
    for bands in options.bands:
        make_demo_scene(folder / f"bands-{bands}", size, bands, views)
        words = ["unmix-nerf", "--data", str(folder / f"bands-{bands}"), "--output-dir", str(folder / "runs")]
        words += ["--pipeline.model.num-endmembers", str(options.num_endmembers), "--device", options.device]
        trainers.append(_common.quiet_trainer([*words, "--max-num-iterations", str(warm_up_steps)]))
    many, few = trainers
    print(f"training {warm_up_steps} steps at {options.bands[0]} bands ...", flush=True)
    many.train()
    few.pipeline.train()
    num_rays = many.pipeline.datamanager.get_train_rays_per_batch()
    for trainer in trainers:
        trainer.pipeline.datamanager.set_train_rays_per_batch(num_rays)
    return many, few


def measure(
    trainers: tuple[Trainer, Trainer], first: int, steps: int, progress: float
) -> tuple[list[StepCost], list[StepCost]]:
    """Costs of steps taken in turn; the trainer that goes first changes from pair to pair."""
    print(f"measuring {steps} pairs of steps ...", flush=True)
    costs: dict[Trainer, list[StepCost]] = {trainer: [] for trainer in trainers}
    for step in range(first, first + UNTIMED_STEPS + steps):
        for trainer in trainers:
            run_callbacks(trainer.callbacks, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, step, progress)
        share_state(*trainers)
        pair = {trainer: timed_step(trainer, step) for trainer in (trainers if step % 2 else trainers[::-1])}
        if len({(cost.num_rays, cost.num_samples) for cost in pair.values()}) != 1:
            raise AssertionError(f"the two models did not take the same samples in step {step}: {pair}")
        if step >= first + UNTIMED_STEPS:
            for trainer, cost in pair.items():
                costs[trainer].append(cost)
    return costs[trainers[0]], costs[trainers[1]]


def share_state(source: Trainer, target: Trainer) -> None:
    """Give the second model field and occupancy grid of the first; neither depends on the bands."""
    models = [trainer.pipeline.model for trainer in (source, target)]
    first, second = (model for model in models if isinstance(model, UnmixModel))
    second.field.load_state_dict(first.field.state_dict())
    second.grid.load_state_dict(first.grid.state_dict())


def timed_step(trainer: Trainer, step: int) -> StepCost:
    """Forward, backward and optimiser."""
    trainer.pipeline.seed_step(step)
    synchronise(trainer)
    wall, cpu = time.perf_counter(), time.process_time()
    trainer.optimizer.zero_grad()
    batches = work_on_batches(trainer.pipeline, step)
    trainer.optimizer.step()
    run_callbacks(trainer.callbacks, TrainingCallbackLocation.AFTER_TRAIN_ITERATION, step, 1.0)
    synchronise(trainer)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    num_rays = trainer.pipeline.datamanager.get_train_rays_per_batch()
    model = trainer.pipeline.model
    return StepCost(wall, cpu, num_rays, sum(model.num_samples(batch.outputs) for batch in batches))


def synchronise(trainer: Trainer) -> None:
    """Wait for the GPU, if there is one at work."""
    if trainer.pipeline.model.device.type == "cuda":
        torch.cuda.synchronize()


def summarise(costs: list[StepCost]) -> dict[str, Any]:
    """Medians, and every step's times which show their spread."""
    return {
        "wall_ms": 1e3 * median(cost.wall_seconds for cost in costs),
        "cpu_ms": 1e3 * median(cost.cpu_seconds for cost in costs),
        "rays": costs[0].num_rays,
        "samples": median(cost.num_samples for cost in costs),
        "every_wall_ms": [round(1e3 * cost.wall_seconds, 3) for cost in costs],
        "every_cpu_ms": [round(1e3 * cost.cpu_seconds, 3) for cost in costs],
    }


def judge(phase: str, many: dict[str, Any], few: dict[str, Any]) -> list[_common.Figure]:
    """Both ratios of medians; the time of the processor is what other programs disturb least."""
    return [
        RATIO.judge(f"{phase} of training, {name}, ratio of medians", many[key] / few[key])
        for name, key in (("processor time", "cpu_ms"), ("wall time", "wall_ms"))
    ]


def table(named: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """The medians."""
    headers = ("steps", "processor time, ms", "wall time, ms", "rays", "samples")
    rows = [
        (name, f"{found['cpu_ms']:.2f}", f"{found['wall_ms']:.2f}", str(found["rays"]), str(found["samples"]))
        for name, found in named.items()
    ]
    return _common.DetailTable("Medians over steps", headers, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
