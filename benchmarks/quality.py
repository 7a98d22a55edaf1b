"""How well are unseen views predicted, and materials found, after about three minutes of training?

    python benchmarks/quality.py [--scenes DIR] [--steps 3000 | --max-seconds 180]

Trains and evaluates each scene below DIR by the commands that a user would give, with the defaults of everything but
the number of endmembers. Beside the segmentation are two methods that see single images only, scored by the same
code on the true pixels of the evaluation views: k-means on spectra of equal length, and VCA with the nearest endmember
by angle, their spectra found in the training views. Takes four minutes a scene. A step is the same everywhere; a second
is not, where other programs share the machine.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import _common
import _machine
import tyro

if TYPE_CHECKING:
    import torch

    from unmix_plugin.scenes.scene import Scene

PEAK_MEMORY = _common.Limit(3.0, is_upper=True, unit=" GiB")
BASELINES: dict[str, Literal["kmeans", "vca"]] = {"k-means": "kmeans", "VCA": "vca"}
BASELINE_SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class SceneLimits:
    """What is asked of a scene."""

    psnr: _common.Limit
    sam: _common.Limit
    miou: _common.Limit


LIMITS = {
    name: SceneLimits(
        _common.Limit(psnr, psnr_aim, unit=" dB"),
        _common.Limit(sam, sam_aim, is_upper=True, unit=" rad"),
        _common.Limit(miou),
    )
    for name, psnr, psnr_aim, sam, sam_aim, miou in (
        ("table", 33.0, 36.0, 0.035, 0.02, 0.6),
        ("room", 28.0, 32.0, 0.07, 0.04, 0.5),
        ("pots", 31.0, 34.0, 0.045, 0.025, 0.55),
    )
}
"""By name of the scene's folder; of other scenes the figures are reported only."""


@dataclass(frozen=True)
class Options:
    """Train and evaluate on each scene, beside two methods that see single images only."""

    scenes: Path | None = None
    """Folder of scene folders; None: those of scenes.py."""
    only: tuple[str, ...] = ()
    """Names of the scenes to run; all if none is given. The others keep their earlier results, if they have the same
    setting."""
    steps: int = 3000
    """Steps of training a scene."""
    max_seconds: float | None = None
    """Seconds of training a scene, in place of steps."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    runs: Path | None = None
    """Keep the run folders here."""
    results: Path | None = None
    """Folder for quality.json and quality.md; None: beside the benchmarks."""
    quick: bool = False
    """Three seconds of training a scene."""


def main(options: Options) -> None:
    """Measure every scene and publish."""
    folders = _common.scene_folders(options.scenes, options.only)
    machine = _machine.describe_machine(options.device)
    seconds = 3.0 if options.quick else options.max_seconds
    limit: dict[str, float] = {"steps": options.steps} if seconds is None else {"max_seconds": seconds}
    setting = {
        **limit,
        "device": options.device,
        "options": "defaults, but --pipeline.model.num-endmembers = number of materials",
        "baseline_seeds": list(BASELINE_SEEDS),
    }
    results = _common.results_folder(options.results, options.quick)
    measured = earlier(results, setting) if options.only else {}
    with ExitStack() as stack:
        runs = options.runs or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-quality-")))
        for folder in folders:
            measured[folder.name] = measure(folder, limit, options.device, runs)
    measured = dict(sorted(measured.items()))
    figures = [figure for name, values in measured.items() for figure in judge(name, values)]
    question = f"Evaluation views after {_in_words(limit)} of training"
    report = _common.Report("quality", question, setting, machine, figures, measured, (details(measured),))
    _common.publish(report, results)


def earlier(results: Path | None, setting: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What was measured before with the same setting, by scene."""
    path = None if results is None else results / "quality.json"
    if path is None or not path.is_file():
        return {}
    report = json.loads(path.read_text(encoding="utf-8"))
    return report["measured"] if report["setting"] == setting else {}


def measure(folder: Path, limit: dict[str, float], device: str, runs: Path) -> dict[str, Any]:
    """Train, evaluate and score the baselines on one scene."""
    num_endmembers = len(json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["materials"])
    load_average = _machine.load_average()
    print(f"{folder.name}: training {_in_words(limit)} with {num_endmembers} endmembers ...", flush=True)
    words = ["unmix-nerf", "--data", str(folder), "--device", device]
    for option, value in limit.items():
        words += ["--max-num-iterations" if option == "steps" else "--max-seconds", f"{value:g}"]
    words += ["--output-dir", str(runs), "--pipeline.model.num-endmembers", str(num_endmembers)]
    trained = _common.run_command([_common.console_script("unmix-train"), *words])
    print(f"{folder.name}: evaluating ...", flush=True)
    evaluate = [_common.console_script("unmix-eval"), "--run", str(trained.run), "--device", device]
    evaluated = _common.run_command(evaluate)
    metrics = json.loads((trained.run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    print(f"{folder.name}: PSNR {metrics['psnr']:.2f} dB; scoring baselines ...", flush=True)
    return {
        "num_endmembers": num_endmembers,
        "load_average_at_start": load_average,
        "revision": _machine.revision(),
        "metrics": {
            **{key: value for key, value in metrics.items() if key not in ("definitions", "per_view")},
            **samples_at_the_end(trained.run),
        },
        "per_view": metrics["per_view"],
        "training_peak_gib": trained.peak_bytes / 2**30,
        "training_command_seconds": trained.seconds,
        "training_cpu_seconds": trained.cpu_seconds,
        "evaluation_command_seconds": evaluated.seconds,
        "baseline_miou": baselines(folder, num_endmembers),
    }


def baselines(folder: Path, num_endmembers: int) -> dict[str, list[float]]:
    """mIoU of each method that sees single images only, by seed; empty without labels."""
    import torch
    from _unmixing_2d import opaque_pixels

    from unmix_plugin.scenes.reading.loader import load_scene
    from unmix_plugin.settings import SceneOptions
    from unmix_plugin.spectral.unmixing.endmembers import initialise_endmembers

    scene = load_scene(folder, SceneOptions())
    if not scene.has_labels:
        return {}
    pixels = torch.cat([opaque_pixels(scene, index) for index in scene.train_indices])
    found: dict[str, list[float]] = {}
    for name, method in BASELINES.items():
        for seed in BASELINE_SEEDS:
            generator = torch.Generator().manual_seed(seed)
            spectra = initialise_endmembers(pixels, num_endmembers, method, generator)
            found.setdefault(name, []).append(segmentation_miou(scene, spectra))
    return found


def segmentation_miou(scene: Scene, spectra: torch.Tensor) -> float:
    """Score the nearest of `spectra` (K, B) by angle at each true pixel of the evaluation views."""
    import torch

    from unmix_plugin.spectral.segmentation import (
        NOTHING_ID,
        SegmentationTally,
        material_ids,
        material_scores,
    )

    assert scene.material_names is not None
    tally = SegmentationTally(len(spectra), len(scene.material_names))
    for index in scene.eval_indices:
        scores = material_scores(torch.from_numpy(scene.cube(index)), spectra)
        labels, valid = scene.labels(index), torch.tensor(scene.valid_mask(index))
        ids = material_ids(scores, torch.ones(scores.shape[:-1]))
        tally.add(ids, torch.where(valid, torch.tensor(labels), NOTHING_ID).to(torch.uint8))
    return tally.scores().miou


def samples_at_the_end(run: Path) -> dict[str, float]:
    """Samples a ray evaluated and visible, and the share of cells occupied, in the last line of a training."""
    lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    last = [line for line in map(json.loads, lines) if line["split"] == "train"][-1:]
    wanted = ("samples_per_ray", "visible_samples_per_ray", "occupied_share")
    return {key: line[key] for line in last for key in wanted}


def judge(name: str, values: dict[str, Any]) -> list[_common.Figure]:
    """The lines of a scene."""
    metrics, limits = values["metrics"], LIMITS.get(name)
    beside = ", ".join(f"{method} {_span(found)}" for method, found in values["baseline_miou"].items())
    miou = f"{name}: mIoU (beside: {beside})" if beside else f"{name}: mIoU"
    peak = PEAK_MEMORY.judge(f"{name}: peak memory of training", values["training_peak_gib"])
    if limits is None:
        found = [_common.reported(f"{name}: {key}", _number(metrics[key])) for key in ("psnr", "sam")]
        return [*found, _common.reported(miou, _number(metrics["miou"])), peak]
    return [
        limits.psnr.judge(f"{name}: PSNR", metrics["psnr"]),
        limits.sam.judge(f"{name}: SAM", metrics["sam"]),
        limits.miou.judge(miou, metrics["miou"]),
        peak,
    ]


def details(measured: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """Every metric of every scene."""
    names = {name: None for values in measured.values() for name in values["metrics"]}
    rows = [[name, *(_number(values["metrics"].get(name)) for values in measured.values())] for name in names]
    rows += [
        [key.replace("_", " "), *(_number(values[key]) for values in measured.values())]
        for key in ("load_average_at_start", "training_command_seconds", "training_cpu_seconds")
    ]
    return _common.DetailTable("All metrics", ["metric", *measured], rows)


def _in_words(limit: dict[str, float]) -> str:
    return " and ".join(f"{value:g} {'steps' if key == 'steps' else 's'}" for key, value in limit.items())


def _span(values: list[float]) -> str:
    return f"{min(values):.2f}-{max(values):.2f}"


def _number(value: float | list[str] | None) -> str:
    if isinstance(value, list):  # what was aligned before views were compared
        return ", ".join(value)
    return "" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
