"""How well do five releases of a camera with four lenses over land do? A made-up flight, trained with the defaults.

    python benchmarks/flight.py [--steps 2500]

No lens shares a band with another, no place is seen more than five times by a lens, and the cameras look at no one
place. The release in the middle is for evaluation. Each seed makes other land.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _flight_scene
import _machine
import tyro

SHOWN = ("psnr", "ssim", "miou", "accuracy", "train_seconds")


@dataclass(frozen=True)
class Options:
    """Train on flights."""

    releases: int = 5
    """Of the shutter, on a line."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the land."""
    steps: int = 2500
    """Of each training."""
    results: Path | None = None
    """Folder for flight.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Ten steps of each."""


def main(options: Options) -> None:
    """Train on each flight and publish."""
    machine, measured = _machine.describe_machine("cpu"), {}
    for seed in options.seeds:
        with tempfile.TemporaryDirectory(prefix="unmix-flight-") as folder:
            measured[f"land {seed}"] = measure(options, seed, Path(folder))
    figures = [
        _common.reported(f"{name}: {key}", f"{found[key]:.4g}{unit}")
        for name, found in measured.items()
        for key, unit in (("psnr", " dB"), ("ssim", ""), ("miou", ""))
    ]
    lenses = [f"psnr of {lens}" for lens in _flight_scene.LENSES]
    rows = [[key, *(f"{found[key]:.4g}" for found in measured.values())] for key in (*SHOWN, *lenses)]
    table = _common.DetailTable("All figures", ["metric", *measured], rows)
    setting = {"releases": options.releases, "steps": _steps(options), "options": "defaults"}
    question = "Four lenses over land, few views"
    report = _common.Report("flight", question, setting, machine, figures, measured, (table,))
    _common.publish(report, _common.results_folder(options.results, options.quick))


def _steps(options: Options) -> int:
    return 10 if options.quick else options.steps


def measure(options: Options, seed: int, folder: Path) -> dict[str, Any]:
    """Train on a flight and evaluate."""
    print(f"land {seed}: rendering ...", flush=True)
    data = _flight_scene.write_flight(folder / "flight", options.releases, seed)
    train, evaluate = (_common.console_script(f"unmix-{command}") for command in ("train", "eval"))
    words = ["--data", str(data), "--max-num-iterations", str(_steps(options)), "--device", "cpu"]
    words += ["--output-dir", str(folder / "runs"), "--viewer.no-enabled"]
    run = _common.run_command([train, "unmix-nerf", *words]).run
    _common.run_command([evaluate, "--run", str(run), "--device", "cpu"])
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    print(f"land {seed}: PSNR {metrics['psnr']:.2f} dB", flush=True)
    lenses = {f"psnr of {lens}": found["psnr"] for lens, found in metrics["per_sensor"].items()}
    return {**{key: metrics[key] for key in SHOWN}, **lenses}


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
