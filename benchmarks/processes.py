"""What do several processes give that train one model together, and what would more devices?

    python benchmarks/processes.py

Trains on the built-in scene (or `--scene DIR`) in one process and in two that share the cores, with as many steps and
rays, by the commands that a user would give, and evaluates both. Then short trainings in one process on one core with
fewer samples per step tell which part of a step the rays share out; from it, and from the bytes that are exchanged,
follows what 1, 2, 4 and 8 devices of this core's speed would reach. Takes about five minutes.
"""

from __future__ import annotations

import itertools
import json
import os
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import tyro

from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint
from unmix_plugin.model import SAMPLES_ON_CPU

PSNR_DIFFERENCE = _common.Limit(0.2, is_upper=True, unit=" dB")
MIOU_DIFFERENCE = _common.Limit(0.02, is_upper=True)
SHARES = (1.0, 0.5, 0.25, 0.125)
"""Of the usual samples per step."""
DEVICES = (1, 2, 4, 8)
NETWORKS = {"10 Gbit/s Ethernet": 1.25e9, "100 Gbit/s": 12.5e9}
"""Bytes a second."""
SAMPLES = "--pipeline.model.samples-per-step"
FULL_SAMPLES = SAMPLES_ON_CPU


@dataclass(frozen=True)
class Options:
    """One process beside two."""

    scene: Path = Path("demo")
    """Scene folder; demo: the built-in one."""
    steps: int = 600
    """Training steps of both."""
    results: Path | None = None
    """Folder for processes.json and processes.md; None: beside the benchmarks."""
    quick: bool = False
    """Thirty steps."""


def main(options: Options) -> None:
    """Train, evaluate, model, publish."""
    machine = _machine.describe_machine()
    steps = 30 if options.quick else options.steps
    with tempfile.TemporaryDirectory(prefix="unmix-processes-") as name:
        folder = Path(name)
        runs = {count: trained(options.scene, folder, steps, count) for count in (1, 2)}
        step_bytes = exchanged_bytes(runs[1]["run"])
        seconds = [step_seconds(options.scene, folder, max(20, steps // 6), share) for share in SHARES]
    fixed, shared = straight_line(SHARES, seconds)
    rows = simulated(fixed, shared, step_bytes, runs[1]["rays"] / steps)
    measured = {
        "runs": {str(count): {k: v for k, v in run.items() if k != "run"} for count, run in runs.items()},
        "bytes_a_step": step_bytes,
        "seconds_a_step_by_share_of_samples": dict(zip(map(str, SHARES), seconds, strict=True)),
        "fixed_seconds": fixed,
        "shared_seconds": shared,
        "simulated": rows,
    }
    setting = {"scene": options.scene.name, "steps": steps, "networks_bytes_a_second": NETWORKS}
    report = _common.Report(
        "processes",
        "Training in several processes: the same model, and what it costs",
        setting,
        machine,
        figures_of(runs),
        measured,
        [simulation_table(rows)],
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def trained(scene: Path, folder: Path, steps: int, count: int) -> dict[str, Any]:
    """A run by `count` processes, with its figures."""
    print(f"training {steps} steps in {count} process(es) ...", flush=True)
    words = training_words(scene, folder, steps)
    run = _common.run_command([*words, "--machine.num-devices", str(count)]).run
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(run)])
    figures = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    record = json.loads((run / "training.json").read_text(encoding="utf-8"))
    return {
        "run": run,
        "psnr": figures["psnr"],
        "miou": figures["miou"],
        "seconds": record["train_seconds"],
        "rays": record["total_rays"],
    }


def training_words(scene: Path, folder: Path, steps: int) -> list[str]:
    """The command that trains."""
    return [
        _common.console_script("unmix-train"),
        "unmix-nerf",
        "--data",
        str(scene),
        "--output-dir",
        str(folder),
        "--max-num-iterations",
        str(steps),
        "--device",
        "cpu",
    ]


def step_seconds(scene: Path, folder: Path, steps: int, share: float) -> float:
    """Median seconds of a step on one core with a share of the usual samples."""
    words = [
        *training_words(scene, folder, steps),
        SAMPLES,
        str(int(share * FULL_SAMPLES)),
        "--steps-per-log",
        "1",
    ]
    run = _common.run_command(words, env={**os.environ, "OMP_NUM_THREADS": "1"}).run
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    seconds = [line["seconds"] for line in lines if line["split"] == "train"]
    return statistics.median(later - earlier for earlier, later in itertools.pairwise(seconds))


def exchanged_bytes(run: Path) -> int:
    """Bytes of the gradients that each process gives in a step."""
    checkpoint = newest_complete_checkpoint(run / "checkpoints")
    tensors = checkpoint.tensors
    return sum(4 * value.numel() for name, value in tensors.items() if name.endswith("/exp_avg"))


def straight_line(shares: Sequence[float], seconds: Sequence[float]) -> tuple[float, float]:
    """Least squares of seconds = fixed + shared * share."""
    fit = statistics.linear_regression(shares, seconds)
    return max(0.0, fit.intercept), fit.slope


def simulated(fixed: float, shared: float, num_bytes: int, rays: float) -> list[dict[str, Any]]:
    """Seconds a step and rays a second for each number of devices and each network.

    An exchange of n bytes among P devices by a ring sends 2 (P - 1) / P n bytes through each of them.
    """
    found = []
    for network, speed in NETWORKS.items():
        for count in DEVICES:
            sent = 2 * (count - 1) / count * num_bytes
            seconds = fixed + shared / count + sent / speed
            found.append(
                {
                    "network": network,
                    "devices": count,
                    "bytes": sent,
                    "seconds": seconds,
                    "rays_per_second": rays / seconds,
                }
            )
    return found


def figures_of(runs: Mapping[int, Mapping[str, Any]]) -> list[_common.Figure]:
    """Two processes beside one."""
    one, two = runs[1], runs[2]
    return [
        PSNR_DIFFERENCE.judge("PSNR, one process against two", abs(one["psnr"] - two["psnr"])),
        MIOU_DIFFERENCE.judge("mIoU, one process against two", abs(one["miou"] - two["miou"])),
        _common.reported("PSNR", f"{one['psnr']:.2f} and {two['psnr']:.2f} dB"),
        _common.reported("mIoU", f"{one['miou']:.3f} and {two['miou']:.3f}"),
        _common.reported("rays", f"{one['rays']:,} and {two['rays']:,}"),
        _common.reported(
            "seconds of training on the same cores", f"{one['seconds']:.1f} and {two['seconds']:.1f} s"
        ),
    ]


def simulation_table(rows: Sequence[Mapping[str, Any]]) -> _common.DetailTable:
    """What more devices would reach."""
    headers = ("network", "devices", "MB sent a step by each", "ms a step", "rays/s")
    cells = [
        (
            row["network"],
            str(row["devices"]),
            f"{row['bytes'] / 1e6:.2f}",
            f"{1e3 * row['seconds']:.1f}",
            f"{row['rays_per_second']:,.0f}",
        )
        for row in rows
    ]
    return _common.DetailTable("Simulated: devices as fast as one core of this machine", headers, cells)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
