"""What do careless captures cost? The demo scene, undisturbed and disturbed, trained with the defaults for equal steps.

    python benchmarks/disturbed.py [--steps 1200] [--only light]

Disturbed are the training views only, except for the light that moves with the camera; every figure is taken on true
evaluation views. Noise is trained twice, with the defaults and with values kept and bands that count alike.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _disturbed_scene as disturbing
import _machine
import tyro

LARGEST_LOSS_DB, LARGEST_LOSS_MIOU = 1.0, 0.03
BASE = "undisturbed"
SHOWN = ("psnr", "psnr_matter", "sam", "miou", "abundance_rmse", "endmember_angle", "train_seconds")
KEPT_NOISE = "noise, nothing done about it"
WORDS = {
    KEPT_NOISE: (
        *("--pipeline.datamanager.no-mend-values",),
        *("--pipeline.model.losses.band-weights", *["1"] * 31),
    )
}
"""That a command gets beside the scene's."""


@dataclass(frozen=True)
class Options:
    """Train on the demo scene, undisturbed and disturbed."""

    steps: int = 1200
    """Of each training."""
    only: tuple[str, ...] = ()
    """Disturbances to train on; all if none is given. What is written is named after them: disturbed-light."""
    runs: Path | None = None
    """Keep scenes and run folders here."""
    results: Path | None = None
    """Folder for disturbed.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Ten steps of each, on small pictures."""


def main(options: Options) -> None:
    """Measure every disturbance and publish."""
    machine = _machine.describe_machine("cpu")
    steps = 10 if options.quick else options.steps
    measured: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        place = Path(
            options.runs or stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-disturbed-"))
        )
        for name, folder in write_scenes(place / "scenes", options).items():
            measured[name] = measure(name, folder, steps, place / "runs")
    figures = [
        figure
        for name, found in measured.items()
        if name not in (BASE, KEPT_NOISE)
        for figure in judge(name, found, measured[BASE])
    ]
    rows = [[key, *(f"{found[key]:.4g}" for found in measured.values())] for key in SHOWN]
    table = _common.DetailTable("All figures", ["metric", *measured], rows)
    question = "What disturbances of the demo scene cost on true evaluation views"
    setting, tables, variant = {"steps": steps}, (table,), "-".join(options.only)
    report = _common.Report("disturbed", question, setting, machine, figures, measured, tables, variant)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def write_scenes(folder: Path, options: Options) -> dict[str, Path]:
    """The scene and what is asked for of its disturbed copies."""
    from unmix_plugin.scenes.demo.scene import make_demo_scene

    source = folder / BASE
    make_demo_scene(source, size=24 if options.quick else 96, overwrite=True)
    changes = {
        "gains": disturbing.gains,
        "masks": disturbing.masks,
        "noise": disturbing.noise,
        KEPT_NOISE: disturbing.noise,
    }
    scenes = {BASE: source}
    if "light" in (options.only or ("light",)):
        scenes["light"] = disturbing.write_lit_by_camera(source, folder / "light")
    for name, change in changes.items():
        if name in (options.only or changes):
            scenes[name] = disturbing.write_disturbed(source, folder / name.replace(" ", "-"), change)
    return scenes


def measure(name: str, folder: Path, steps: int, runs: Path) -> dict[str, Any]:
    """Train and evaluate."""
    print(f"{name}: training ...", flush=True)
    train, evaluate = (_common.console_script(f"unmix-{command}") for command in ("train", "eval"))
    words = ["--data", str(folder), "--max-num-iterations", str(steps), "--output-dir", str(runs)]
    words += ["--device", "cpu", "--viewer.no-enabled", *WORDS.get(name, ())]
    run = _common.run_command([train, "unmix-nerf", *words]).run
    _common.run_command([evaluate, "--run", str(run), "--device", "cpu"])
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    print(f"{name}: PSNR {metrics['psnr']:.2f} dB, mIoU {metrics['miou']:.3f}", flush=True)
    return {key: metrics[key] for key in SHOWN}


def judge(name: str, found: dict[str, Any], base: dict[str, Any]) -> list[_common.Figure]:
    """Loss of quality against the undisturbed scene."""
    loss_db = _common.Limit(LARGEST_LOSS_DB, is_upper=True, unit=" dB")
    return [
        loss_db.judge(f"{name}: PSNR lost", base["psnr"] - found["psnr"]),
        _common.Limit(LARGEST_LOSS_MIOU, is_upper=True).judge(
            f"{name}: mIoU lost", base["miou"] - found["miou"]
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
