"""How well does an object look under light that it was never photographed in?

    python benchmarks/neumatex.py [--objects 8] [--size 64] [--steps 300] [--lights 4]

Writes procedural objects of layered materials whose seeds were not used while settings were chosen, fits each as
`unmix-train` does it, and evaluates on held-out views, under held-out lights and against the true base colour. A
variant is a family of materials with or without the prior; one is held to it by the prior's true error.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any, Literal

import _common
import _machine
import tyro
from _neumatex_fit import measured_fit

RELIT = _common.Limit(30.0, unit=" dB")
ABOVE_PBR = _common.Limit(3.0, unit=" dB")
BASE_COLOUR = _common.Limit(25.0, unit=" dB")
BELOW_ORACLE = _common.Limit(0.5, is_upper=True, unit=" dB")
SECONDS = _common.Limit(600.0, is_upper=True, unit=" s")
PEAK_MEMORY = _common.Limit(4.0, is_upper=True, unit=" GiB")
MAIN, BASELINE = "neural", "pbr"
ORACLE = "neural, oracle's uncertainty"
"""Held to the prior by its true squared error, which is known for generated objects only."""
VARIANTS: dict[str, tuple[str, ...]] = {
    MAIN: ("--pipeline.model.material", "neural"),
    BASELINE: ("--pipeline.model.material", "pbr"),
    "neural, no prior": ("--pipeline.model.prior", "none"),
    "pbr, no prior": ("--pipeline.model.material", "pbr", "--pipeline.model.prior", "none"),
    "neural, not held to the prior": ("--pipeline.model.regularisation", "0"),
    ORACLE: (),
    "neural, planes alone": ("--pipeline.model.no-fit-networks",),
    "neural, as published": ("--pipeline.model.no-fit-networks", "--pipeline.model.regularisation", "2"),
}
COLUMNS = {
    "relit_psnr": "relit PSNR",
    "psnr": "PSNR, held-out views",
    "base_colour_psnr": "base colour PSNR",
    "base_colour_psnr_scaled": "base colour PSNR, scaled",
    "relit_psnr_image": "relit PSNR, whole image",
    "train_seconds": "training, s",
    "train_cpu_seconds": "training, s of CPU",
    "training_peak_gib": "peak memory, GiB",
}


@dataclass(frozen=True)
class Options:
    """Fit unseen objects in several ways, and look at them under lights that were held out."""

    objects: int = 8
    """How many objects, of seeds 0, 1, ..."""
    size: int = 64
    """Rows and columns of the pictures."""
    views: int = 24
    """Pictures of an object under the light of training."""
    lights: int = 4
    """Held-out lights."""
    steps: int = 300
    """Training steps."""
    pixels: int = 512
    """Pixels a step."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which ways of fitting."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    processes: int = 1
    """Fits at once, each with one thread if there are several; seconds are then not those of one alone."""
    runs: Path | None = None
    """Keep objects, run folders and figures here; what is there already is not measured again."""
    results: Path | None = None
    """Folder for neumatex.json and neumatex.md; None: beside the benchmarks."""
    measured_only: bool = False
    """Publish what has been measured in `runs`, and fit nothing."""
    quick: bool = False
    """One small object, three steps."""


def main(options: Options) -> None:
    """Measure every variant on every object, and publish."""
    size = (32, 8, 1) if options.quick else (options.size, options.views, options.lights)
    seeds = range(1 if options.quick else options.objects)
    steps = 3 if options.quick else options.steps
    setting = {
        "objects": f"procedural, seeds {seeds.start} to {seeds.stop - 1}",
        "pictures": f"{size[1]} of {size[0]} x {size[0]} pixels, and {size[2]} held-out lights",
        "steps": f"{steps} of {options.pixels} pixels",
        "device": options.device,
        "fits at once": str(options.processes),
        "variants": {name: " ".join(VARIANTS[name]) for name in options.variants},
    }
    machine = _machine.describe_machine(options.device)
    with ExitStack() as stack:
        root = options.runs or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="neumatex-")))
        workers = stack.enter_context(ThreadPoolExecutor(options.processes))
        folders = dict(
            zip(seeds, workers.map(lambda seed: written_object(root, seed, *size), seeds), strict=True)
        )
        words = ["--max-num-iterations", str(steps), "--device", options.device]
        words += ["--pipeline.datamanager.train-num-rays-per-batch", str(options.pixels)]
        fits = [_Fit(folders[seed], seed, name, tuple(words)) for name in options.variants for seed in seeds]
        if options.measured_only:
            fits = [fit for fit in fits if fit.kept(root).exists()]
        found = list(workers.map(lambda fit: measure(fit, root, options.processes), fits))
    measured: dict[str, list[dict[str, Any]]] = {name: [] for name in options.variants}
    for fit, figures in zip(fits, found, strict=True):
        measured[fit.variant].append({"seed": fit.seed, **figures})
    report = _common.Report(
        "neumatex",
        f"Unseen objects under unseen lights after {steps} steps",
        setting,
        machine,
        judge(measured),
        measured,
        (means(measured), details(measured)),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


@dataclass(frozen=True)
class _Fit:
    """One object in one way."""

    folder: Path
    seed: int
    variant: str
    words: tuple[str, ...]

    def kept(self, root: Path) -> Path:
        """Where its figures are kept; others for other settings."""
        words = [*VARIANTS[self.variant], *self.words]
        digest = hashlib.sha256(repr((self.variant, words)).encode()).hexdigest()[:12]
        return root / "measured" / f"{self.seed}-{digest}.json"


def written_object(root: Path, seed: int, size: int, views: int, lights: int) -> Path:
    """An object's folder, made if it is not there."""
    from tools.procedural_objects import seeded_lights, seeded_mesh, seeded_surface
    from unmix_plugin.neumatex.demo.objects import write_object
    from unmix_plugin.scenes.demo.scene import written_once

    def write(folder: Path) -> None:
        print(f"object {seed}: rendering its pictures ...", flush=True)
        shown_in = seeded_lights(seed)[: lights + 1]
        write_object(folder, seeded_mesh(seed), seeded_surface(seed), shown_in, size, views, seed)

    return written_once(root / f"object-{seed}", f"object {seed}", write, Path.is_dir)


def measure(fit: _Fit, root: Path, processes: int) -> dict[str, Any]:
    """Train and evaluate one object in one way, unless that was measured before in the same folder."""
    words, kept = [*VARIANTS[fit.variant], *fit.words], fit.kept(root)
    if not kept.exists():
        load_average = _machine.load_average()
        common = ["neumatex", "--data", str(fit.folder), "--output-dir", str(root / "runs" / fit.variant)]
        oracle_seed = fit.seed if fit.variant == ORACLE else None
        figures = measured_fit([*common, *words], oracle_seed, processes)
        figures["load_average_at_start"] = load_average
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(figures), encoding="utf-8")
    figures = json.loads(kept.read_text(encoding="utf-8"))
    print(f"object {fit.seed}, {fit.variant}: relit {figures['relit_psnr']:.2f} dB", flush=True)
    return figures


def judge(measured: dict[str, list[dict[str, Any]]]) -> list[_common.Figure]:
    """The lines asked for, of means over the objects."""
    everything = [run for runs in measured.values() for run in runs]
    # Fits side by side wait for each other, so that what a clock shows is not theirs.
    figures = [
        SECONDS.judge(
            "longest training, seconds of CPU time", max(run["train_cpu_seconds"] for run in everything)
        ),
        PEAK_MEMORY.judge("peak memory of training", max(run["training_peak_gib"] for run in everything)),
    ]
    if not measured.get(MAIN):
        return figures
    found = [RELIT.judge(f"{MAIN}: relit PSNR", mean_of(measured[MAIN], "relit_psnr"))]
    if measured.get(BASELINE):
        difference = advantage(measured, BASELINE)
        found.append(ABOVE_PBR.judge(f"{MAIN} above {BASELINE}, relit PSNR", difference))
    found.append(BASE_COLOUR.judge(f"{MAIN}: base colour PSNR", mean_of(measured[MAIN], "base_colour_psnr")))
    if measured.get(ORACLE):
        difference = advantage(measured, ORACLE)
        below = None if difference is None else -difference
        found.append(BELOW_ORACLE.judge(f"{ORACLE} above {MAIN}, relit PSNR", below))
    return [*found, *figures]


def advantage(measured: dict[str, list[dict[str, Any]]], variant: str) -> float | None:
    """By how much the relit PSNR of the main variant exceeds another's, over the objects of the other."""
    seeds = {run["seed"] for run in measured[variant]}
    same = [run for run in measured[MAIN] if run["seed"] in seeds]
    ours, other = mean_of(same, "relit_psnr"), mean_of(measured[variant], "relit_psnr")
    return None if ours is None or other is None or len(same) < len(seeds) else ours - other


def mean_of(runs: list[dict[str, Any]], name: str) -> float | None:
    """Mean over the objects; None where one has no such figure."""
    values = [float(run[name]) for run in runs if run.get(name) is not None]
    return mean(values) if values and len(values) == len(runs) else None


def means(measured: dict[str, list[dict[str, Any]]]) -> _common.DetailTable:
    """A line a variant."""
    rows = [
        [
            name,
            str(len(runs)),
            _text(advantage(measured, name)),
            *(_text(mean_of(runs, column)) for column in COLUMNS),
        ]
        for name, runs in measured.items()
        if runs
    ]
    headers = ["variant", "objects", f"{MAIN} above it on these, relit PSNR", *COLUMNS.values()]
    return _common.DetailTable("Means over the objects, dB", headers, rows)


def details(measured: dict[str, list[dict[str, Any]]]) -> _common.DetailTable:
    """A line an object and variant."""
    rows = [
        [str(run["seed"]), name, *(_text(run.get(column)) for column in COLUMNS)]
        for name, runs in measured.items()
        for run in runs
    ]
    return _common.DetailTable("Each object", ["object", "variant", *COLUMNS.values()], sorted(rows))


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
