"""Does unmixing inside the field beat the obvious rival: a field of free spectra, unmixed afterwards?

    python benchmarks/field_first.py [--scenes DIR] [--steps 600] [--seeds 0 1 2] [--runs DIR]

The rival is our own field with spectra as free as it can make them: 16 spectra, each with a brightness of its own at
every point, no guide. Its renders of some training views are searched for the true number of endmembers, by VCA, by
pairs and by the pooled search, and its renders of evaluation views are explained by non-negative least squares. Beside
it stand our defaults, and the defaults with the pooled search for first endmembers, after as many steps with the same
seed. All are scored on the same evaluation views by the same code. `--runs` keeps run folders, KIND-SEED/SCENE/..., and
uses those that are there.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import _common
import _machine
import torch
import tyro
from _unmixing_methods import find_endmembers
from torch import Tensor

from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.segmentation import material_scores
from unmix_plugin.spectral.unmixing.abundances import nnls
from unmix_plugin.trained.evaluation import (
    Evaluation,
    PredictedView,
    render_view,
    scene_truth,
    view_truth,
)
from unmix_plugin.trained.open_run import open_run
from unmix_plugin.trained.trained_scene import TrainedScene

_MODEL = "--pipeline.model"
KINDS = {
    "ours": [],
    "pooled": [f"{_MODEL}.endmember-init", "pooled"],
    "free": [
        *(f"{_MODEL}.num-endmembers", "16"),
        *(f"{_MODEL}.endmember-init", "kmeans"),
        *(f"{_MODEL}.field.scale", "per-endmember"),
        *(f"{_MODEL}.losses.abundances", "0"),
    ],
}
"""What a training is given besides the scene, the seed, the steps and the number of materials."""
_FINDERS = {"VCA": "vca", "pairs": "pairs", "pooled": "pooled"}
_VIEWS = 4
"""Evaluation views that count, and training views that are rendered to find endmembers in."""
_SHOWN = ("miou", "abundance_rmse", "endmember_angle", "psnr")


@dataclass(frozen=True)
class Options:
    """Train both, unmix one of them afterwards."""

    scenes: Path = field(default_factory=_common.scenes_folder)
    """Folder of scene folders with labels, abundances and true spectra."""
    only: tuple[str, ...] = ("table", "room", "pots", "turntable")
    """Names of the scenes."""
    steps: int = 600
    """Of each training."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One training of each kind."""
    runs: Path | None = None
    """Where run folders are kept and looked for."""
    only_existing: bool = False
    """Train nothing: score the runs that are there."""
    results: Path | None = None
    """Folder for field_first.json and .md; None: beside the benchmarks."""


def main(options: Options) -> None:
    """Train what is missing, score, publish."""
    if not options.only_existing:
        _common.require_scenes(*(options.scenes / name for name in options.only))
    measured: dict[str, dict[str, list[dict[str, float]]]] = {}
    with ExitStack() as stack:
        runs = options.runs or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-field-first-"))
        )
        for name in options.only:
            rows = measured.setdefault(name, {})
            for seed in options.seeds:
                for kind in KINDS:
                    run = _run(options, runs, name, kind, seed)
                    if run is None:
                        continue
                    for row, figures in _scored(options.scenes / name, run, kind, seed).items():
                        rows.setdefault(row, []).append(figures)
                        print(name, seed, row, {key: round(figures[key], 3) for key in _SHOWN}, flush=True)
    report = _common.Report(
        "field_first",
        f"Unmixing inside the field and after it, at {options.steps} equal steps: medians over seeds",
        {"steps": options.steps, "views": _VIEWS} | {kind: " ".join(words) for kind, words in KINDS.items()},
        _machine.describe_machine("cpu"),
        [],
        measured,
        [_table(name, rows) for name, rows in measured.items()],
    )
    _common.publish(report, _common.results_folder(options.results, quick=False))


def _run(options: Options, runs: Path, scene: str, kind: str, seed: int) -> Path | None:
    """The run folder, trained if it is not there."""
    place = runs / f"{kind}-{seed}"
    there = sorted(place.glob(f"{scene}/*/*/checkpoints/step-*{options.steps}.json"))
    if there:
        return there[-1].parent.parent
    if options.only_existing:
        return None
    folder = options.scenes / scene
    count = len(json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["materials"])
    words = [
        "unmix-nerf",
        "--data",
        str(folder),
        "--output-dir",
        str(place),
        "--device",
        "cpu",
        "--seed",
        str(seed),
    ]
    words += [
        "--max-num-iterations",
        str(options.steps),
        f"{_MODEL}.num-endmembers",
        str(count),
        *KINDS[kind],
    ]
    return _common.run_command([_common.console_script("unmix-train"), *words]).run


def _scored(folder: Path, run: Path, kind: str, seed: int) -> dict[str, dict[str, float]]:
    """Figures by row."""
    scene = load_scene(folder, SceneOptions())
    trained, truth = open_run(run), scene_truth(scene)
    views = {split: [view for view in trained.views if view.split == split] for split in ("train", "eval")}
    steps = {split: max(1, len(found) // _VIEWS) for split, found in views.items()}
    shown = list(zip(scene.eval_indices, views["eval"], strict=True))[:: steps["eval"]][:_VIEWS]
    predicted = [(view_truth(scene, index), render_view(trained, view.camera)) for index, view in shown]
    if kind != "free":
        evaluation = Evaluation(truth, trained.materials.endmembers)
        for view, seen in predicted:
            evaluation.add(view, seen)
        first = "defaults" if kind == "ours" else "defaults, pooled search first"
        return {first: evaluation.figures()}
    pixels = torch.cat([_opaque(trained, view.camera) for view in views["train"][:: steps["train"]][:_VIEWS]])
    rows = {}
    for name, finder in _FINDERS.items():
        found = find_endmembers(pixels, truth.num_materials, finder, torch.Generator().manual_seed(seed))
        evaluation = Evaluation(truth, found)
        for view, seen in predicted:
            evaluation.add(view, _explained(seen, found))
        rows[f"field first, then {name}"] = evaluation.figures()
    return rows


def _opaque(trained: TrainedScene, camera: Any) -> Tensor:
    seen = render_view(trained, camera, 1)
    return seen.spectra[seen.accumulation > 0.99]


def _explained(seen: PredictedView, endmembers: Tensor) -> PredictedView:
    """A rendered view with the abundances that its spectra have."""
    amounts = nnls(seen.spectra.flatten(0, 1), endmembers).unflatten(0, seen.accumulation.shape)
    shares = amounts / amounts.sum(dim=-1, keepdim=True).clamp(min=1e-12)
    ids = amounts.argmax(dim=-1).to(torch.uint8)
    return PredictedView(
        seen.spectra,
        seen.accumulation,
        shares * seen.accumulation[..., None],
        torch.where(seen.accumulation > 0.5, ids, 255).to(torch.uint8),
        material_scores(seen.spectra, endmembers),
    )


def _table(scene: str, rows: dict[str, list[dict[str, float]]]) -> _common.DetailTable:
    lines = [
        [row, str(len(seeds)), *(f"{statistics.median(seed[key] for seed in seeds):.3f}" for key in _SHOWN)]
        for row, seeds in rows.items()
    ]
    return _common.DetailTable(scene, ["row", "seeds", *_SHOWN], lines)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
