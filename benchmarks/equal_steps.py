"""Does another revision reach as much in as many steps, and as many steps in as much time?

    python benchmarks/equal_steps.py --before CHECKOUT [--scenes DIR] [--steps 1000]

Trains every scene below DIR with the package of another checkout and with that of this one, in turn, for equally many
steps from the same seed, evaluates both with their own command, and compares PSNR, mIoU and the processor time of the
whole training command.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import tyro


@dataclass(frozen=True)
class Options:
    """Compare two revisions at equal steps."""

    before: Path
    """Checkout of the other revision."""
    scenes: Path | None = None
    """Folder of scene folders; None: those of scenes.py."""
    only: tuple[str, ...] = ()
    """Names of the scenes; all if none is given."""
    steps: int = 1000
    """Of each training."""
    repeats: int = 1
    """Pairs of trainings a scene, of which speeds are the medians."""
    results: Path | None = None
    """Folder for equal_steps.json and equal_steps.md; None: beside the benchmarks."""


def main(options: Options) -> None:
    """Train in pairs, evaluate, publish."""
    machine, measured = _machine.describe_machine("cpu"), {}
    folders = _common.scene_folders(options.scenes, options.only)
    names = [folder.name for folder in folders]
    checkouts = {"before": options.before.resolve(), "now": _common.REPOSITORY}
    for name, data in zip(names, folders, strict=True):
        runs: dict[str, list[dict[str, float]]] = {"before": [], "now": []}
        for _ in range(options.repeats):
            for which, checkout in checkouts.items():
                runs[which].append(_trained(checkout, data, options.steps))
        measured[name] = {which: _median(found) for which, found in runs.items()}
    figures = [figure for name, found in measured.items() for figure in _figures(name, found)]
    setting = {"steps": options.steps, "repeats": options.repeats, "scenes": names}
    question = f"Two revisions at {options.steps} equal steps"
    report = _common.Report("equal_steps", question, setting, machine, figures, measured)
    _common.publish(report, _common.results_folder(options.results, quick=False))


def _trained(checkout: Path, scene: Path, steps: int) -> dict[str, float]:
    """Figures of one training, by the commands of a checkout."""
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    with tempfile.TemporaryDirectory(prefix="unmix-steps-") as folder:
        place = Path(folder)
        words = ["unmix-nerf", "--data", str(scene.resolve()), "--max-num-iterations", str(steps)]
        materials = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))["materials"]
        words += ["--pipeline.model.num-endmembers", str(len(materials)), "--device", "cpu"]
        ended = _common.run_command(_command("train", words), place, env)
        [run] = place.glob("outputs/*/*/*")
        _common.run_command(_command("evaluate", ["--run", str(run), "--device", "cpu"]), place, env)
        metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    found: dict[str, Any] = {**metrics, **metrics.get("means", {})}
    return {"psnr": float(found["psnr"]), "miou": float(found["miou"]), "cpu_seconds": ended.cpu_seconds}


def _command(name: str, words: list[str]) -> list[str]:
    code = f"from unmix_plugin.commands.scripts import {name}; {name}()"
    return [sys.executable, "-c", code, *words]


def _median(found: list[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(one[key] for one in found) for key in found[0]}


def _figures(name: str, found: dict[str, dict[str, float]]) -> list[_common.Figure]:
    before, now = found["before"], found["now"]
    decibels, share = now["psnr"] - before["psnr"], now["miou"] - before["miou"]
    told = f"{now['psnr']:.2f} dB, {before['psnr']:.2f} before"
    return [
        _common.required(f"{name}: PSNR", "at most 0.1 dB less", decibels >= -0.1, told),
        _common.required(
            f"{name}: mIoU",
            "at most 0.005 less",
            share >= -0.005,
            f"{now['miou']:.3f}, {before['miou']:.3f} before",
        ),
        _common.reported(
            f"{name}: processor time over that before",
            f"{now['cpu_seconds'] / max(before['cpu_seconds'], 1e-9):.3f}",
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options))
