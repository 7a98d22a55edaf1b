"""How fast are the rendering operators, beside their PyTorch twins and in real training?

    python benchmarks/operators.py [--device cuda]

Trains on the built-in scene for a while (which gives the rays and samples a second of real training), then takes the
rays of the next step, the trained hash table and the occupancy grid, and measures kernels and twins in turn on the
same input. "All together" is what a training step does with them: march, encode, weigh, accumulate, and back to the
table. The small networks between encoding and weights are left out on both sides: what they would hand on, forward and
backward, is given. Takes two minutes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Literal

import _common
import _machine
import torch
import tyro
from torch import Tensor

from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.field import UnmixField
from unmix_plugin.model import UnmixModel
from unmix_plugin.operators import compositing, hash_encoding, marching
from unmix_plugin.operators.hash_encoding import HashGridLayout
from unmix_plugin.operators.marching import PackedSamples
from unmix_plugin.scenes.demo.scene import DEFAULT_SIZE, DEFAULT_VIEWS, make_demo_scene

SPEED_UP = _common.Limit(8.0, unit=" x")
WHOLE = "all together, forward and backward"
UNTIMED_ROUNDS = 2
NUM_CHANNELS = 15
"""Numbers accumulated a ray: 2 for opacity and distance, 6 abundances, 6 scaled ones, 1 specular coefficient."""


@dataclass(frozen=True)
class Options:
    """Rendering operators beside their twins, and samples a second of real training."""

    training_steps: int = 400
    """Training steps before the measurement; the second half of them gives the speed of real training."""
    rounds: int = 15
    """Measurements of each operator and twin."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute."""
    results: Path | None = None
    """Folder for operators.json (operators-cuda.json on a GPU) and the table; None: beside the benchmarks."""
    quick: bool = False
    """A small scene, few steps and rounds."""


@dataclass(frozen=True)
class Operators:
    """One implementation of each operator."""

    march: Callable[..., PackedSamples]
    hash_encode: Callable[[Tensor, Tensor, HashGridLayout], Tensor]
    volume_weights: Callable[[Tensor, Tensor], Tensor]
    accumulate: Callable[[Tensor, Tensor, Tensor], Tensor]


def _march(*rays_and_grid: Any) -> PackedSamples:
    return marching.rays_in_box(*rays_and_grid).samples()


IMPLEMENTATIONS = {
    "kernel": Operators(
        _march, hash_encoding.hash_encode, compositing.volume_weights, compositing.accumulate
    ),
    "twin": Operators(
        marching.march_twin,
        hash_encoding.hash_encode_twin,
        compositing.volume_weights_twin,
        compositing.accumulate_twin,
    ),
}


class TrainingState:
    """Input of the operators as the next training step would have it, and the tasks that are timed on it."""

    def __init__(self, trainer: Trainer) -> None:
        """Take rays, grid and table from a trainer that has trained."""
        model = trainer.pipeline.model
        assert isinstance(model, UnmixModel)
        field = model.field
        assert isinstance(field, UnmixField)
        bundle, _ = trainer.pipeline.datamanager.next_train(trainer.step)
        renderer = model.renderer
        box = renderer.box
        t_near, t_far = box.intersect(bundle.origins, bundle.directions)
        origins, directions = box.normalise(bundle.origins), bundle.directions / box.size
        generator = torch.Generator().manual_seed(0)
        self.device = t_near.device
        jitter = torch.rand(len(t_near), generator=generator).to(self.device)
        self.marched = (origins, directions, t_near, t_far, jitter, renderer.skips, renderer.step)
        self.samples = _march(*self.marched)
        rays = self.samples.ray_indices
        self.positions = origins[rays] + self.samples.t[:, None] * directions[rays]
        self.layout = field.layout
        self.table = field.table.detach().clone().requires_grad_()
        with torch.no_grad():
            densities, _ = field.get_density(self.positions * box.size + box.aabb[0])
        self.depths = (densities * renderer.step).requires_grad_()
        num_rays, num_samples = len(t_near), len(self.samples)
        num_encoded = self.layout.num_levels * self.layout.features_per_level
        self.values = (
            torch.rand(num_samples, NUM_CHANNELS, generator=generator).to(self.device).requires_grad_()
        )
        self.encoded_cotangent = torch.randn(num_samples, num_encoded, generator=generator).to(self.device)
        self.cotangent = torch.randn(num_rays, NUM_CHANNELS, generator=generator).to(self.device)

    @property
    def tasks(self) -> dict[str, Callable[[Operators], Any]]:
        """What is timed, by name."""
        return {
            "marching": self.march,
            "hash encoding, forward": self.encode_only,
            "hash encoding, forward and backward": self.encode,
            "weights and accumulation, forward and backward": self.composite,
            WHOLE: self.all_together,
        }

    def march(self, operators: Operators) -> PackedSamples:
        """Find the samples."""
        return operators.march(*self.marched)

    @torch.no_grad()
    def encode_only(self, operators: Operators) -> Tensor:
        """Encode all samples."""
        return operators.hash_encode(self.positions, self.table, self.layout)

    def encode(self, operators: Operators) -> tuple[Tensor, ...]:
        """Encode, and back to the table."""
        encoded = operators.hash_encode(self.positions, self.table, self.layout)
        return torch.autograd.grad(encoded, self.table, self.encoded_cotangent)

    def composite(self, operators: Operators) -> tuple[Tensor, ...]:
        """Weigh and accumulate, and back to optical depths and values."""
        weights = operators.volume_weights(self.depths, self.samples.packed_info)
        totals = operators.accumulate(weights, self.values, self.samples.packed_info)
        return torch.autograd.grad(totals, (self.depths, self.values), self.cotangent)

    def all_together(self, operators: Operators) -> tuple[Tensor, ...]:
        """March, encode, weigh, accumulate; back to depths and values, and from the encoding to the table."""
        self.march(operators)
        encoded = operators.hash_encode(self.positions, self.table, self.layout)
        gradients = self.composite(operators)
        return *torch.autograd.grad(encoded, self.table, self.encoded_cotangent), *gradients


def main(options: Options) -> None:
    """Measure and publish."""
    machine = _machine.describe_machine(options.device)
    size, views, steps, rounds = DEFAULT_SIZE, DEFAULT_VIEWS, options.training_steps, options.rounds
    if options.quick:
        size, views, steps, rounds = 32, 8, 20, 2
    with TemporaryDirectory(prefix="unmix-operators-") as folder:
        trainer, training = train(Path(folder), size, views, steps, options.device)
    state = TrainingState(trainer)
    seconds = measure(state, rounds)
    speeds = {name: summarise(found, len(state.samples)) for name, found in seconds.items()}
    setting = {
        "scene": f"built-in, {size} x {size} pixels, {views} views",
        "device": options.device,
        "threads": torch.get_num_threads(),
        "rays": len(state.cotangent),
        "samples": len(state.samples),
        "hash grid": f"{state.layout.num_levels} levels x {state.layout.features_per_level} features, "
        f"{state.layout.num_rows} rows",
        "rounds": rounds,
        "training steps": steps,
        "largest relative difference of gradients, kernels to twins": f"{difference(state):.2g}",
    }
    name = "operators" if options.device == "cpu" else f"operators-{options.device}"
    question = "Samples a second through the rendering operators, kernels / PyTorch twins"
    measured = {"operators": speeds, "training": training}
    report = _common.Report(
        name, question, setting, machine, judge(speeds, training), measured, (table(speeds),)
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def train(folder: Path, size: int, views: int, steps: int, device: str) -> tuple[Trainer, dict[str, float]]:
    """A trainer that has trained on the built-in scene, and how fast it did in the second half."""
    make_demo_scene(folder / "demo", size, views=views)
    words = ["unmix-nerf", "--data", str(folder / "demo"), "--output-dir", str(folder / "runs")]
    words += ["--max-num-iterations", str(steps), "--steps-per-log", "1", "--device", device]
    trainer = _common.quiet_trainer(words)
    print(f"training {steps} steps ...", flush=True)
    trainer.train()
    lines = [line for line in _common.json_lines(trainer.run.metrics_path) if line["split"] == "train"]
    before, counted = lines[steps // 2 - 1], lines[steps // 2 :]
    seconds = counted[-1]["seconds"] - before["seconds"]
    return trainer, {
        "steps_per_second": len(counted) / seconds,
        "rays_per_second": sum(line["num_rays"] for line in counted) / seconds,
        "samples_per_second": sum(line["num_samples"] for line in counted) / seconds,
    }


def measure(state: TrainingState, rounds: int) -> dict[str, dict[str, list[float]]]:
    """Seconds of every task by task and implementation; implementations take turns."""
    seconds: dict[str, dict[str, list[float]]] = {}
    for name, task in state.tasks.items():
        print(f"measuring {name} ...", flush=True)
        found: dict[str, list[float]] = {implementation: [] for implementation in IMPLEMENTATIONS}
        for number in range(UNTIMED_ROUNDS + rounds):
            for implementation, operators in IMPLEMENTATIONS.items():
                taken = timed(task, operators, state.device)
                if number >= UNTIMED_ROUNDS:
                    found[implementation].append(taken)
        seconds[name] = found
    return seconds


def timed(task: Callable[[Operators], Any], operators: Operators, device: torch.device) -> float:
    """Wall time of one task, seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    started = time.perf_counter()
    task(operators)
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - started


def summarise(seconds: dict[str, list[float]], num_samples: int) -> dict[str, Any]:
    """Medians, speeds and their ratio; and every time which show the spread."""
    medians = {name: median(found) for name, found in seconds.items()}
    return {
        "milliseconds": {name: 1e3 * found for name, found in medians.items()},
        "samples_per_second": {name: num_samples / found for name, found in medians.items()},
        "speed_up": medians["twin"] / medians["kernel"],
        "every_millisecond": {
            name: [round(1e3 * value, 3) for value in found] for name, found in seconds.items()
        },
    }


def difference(state: TrainingState) -> float:
    """Largest difference of the gradients from the twins', as a part of the largest value of each."""
    kernels, twins = (state.all_together(operators) for operators in IMPLEMENTATIONS.values())
    return max(
        float((kernel - twin).abs().max() / twin.abs().max())
        for kernel, twin in zip(kernels, twins, strict=True)
    )


def judge(speeds: dict[str, dict[str, Any]], training: dict[str, float]) -> list[_common.Figure]:
    """The whole is judged, its parts and the speed of training are reported."""
    parts = [
        _common.reported(f"{name}, against the twin", f"{found['speed_up']:.4g} x")
        for name, found in speeds.items()
        if name != WHOLE
    ]
    whole = speeds[WHOLE]
    return [
        SPEED_UP.judge(f"{WHOLE}, against the twins", whole["speed_up"]),
        *parts,
        _common.reported(WHOLE, f"{whole['samples_per_second']['kernel']:,.0f} samples/s"),
        _common.reported("real training, networks included", f"{training['rays_per_second']:,.0f} rays/s"),
        _common.reported(
            "real training, networks included", f"{training['samples_per_second']:,.0f} samples/s marched"
        ),
    ]


def table(speeds: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """Median times and speeds of kernels and twins."""
    headers = ("operator", "kernel, ms", "twin, ms", "kernel, samples/s", "twin, samples/s", "ratio")
    rows = []
    for name, found in speeds.items():
        times, rates = found["milliseconds"], found["samples_per_second"]
        milliseconds = [f"{times[key]:.3g}" for key in IMPLEMENTATIONS]
        samples = [f"{rates[key]:,.0f}" for key in IMPLEMENTATIONS]
        rows.append((name, *milliseconds, *samples, f"{found['speed_up']:.3g}"))
    return _common.DetailTable("Medians over rounds", headers, rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
