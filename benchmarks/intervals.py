"""How often do intervals hold what is true, and how wide are they?

    python benchmarks/intervals.py [--only table room] [--max-seconds 90]

Trains on scenes with true abundances by the command that a user would give, and asks in all evaluation views how many
true values lie in intervals of 50, 80, 90 and 95 %: of abundances, of reflectance (radiance where the light is unknown)
and of an index, which both views measured. Abundances are counted twice: all, and those that are there (predicted or
true above 0.05), since nearly every interval holds the 0 of a material that is absent. Nothing is fitted to the
evaluation views. A minute and a half a scene; `--runs FOLDER` measures runs that are there.
"""

from __future__ import annotations

import json
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import numpy as np
import torch
import tyro
from scipy.ndimage import distance_transform_edt
from scipy.stats import spearmanr

from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.trained.evaluation import scene_truth, view_truth
from unmix_plugin.trained.measured_errors import measure_errors
from unmix_plugin.trained.open_run import find_scene, load_run
from unmix_plugin.trained.outputs import interval_ends
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.trained.training_views import thinned_views

COVERAGES = (0.5, 0.8, 0.9, 0.95)
MEDIAN = (0.86, 0.94)
WORST = _common.Limit(0.80)
HALF_WIDTH = _common.Limit(0.08, is_upper=True)
RANK = _common.Limit(0.5)
RENDER = _common.Limit(2.0, is_upper=True, unit=" times")
PROBE = _common.Limit(0.1, is_upper=True, unit=" s")
_THERE = 0.05
"""Abundance from which a material counts as being there."""
_EDGE_PX = (1.5, 4.0)
"""Distances from edges of materials that are told apart."""
_OPAQUE, _SEEN = 0.99, 0.5
_ROUNDING = 1e-6
_MOST_RANKED = 200_000


@dataclass(frozen=True)
class Options:
    """Train and count."""

    scenes: Path | None = None
    """Folder of scene folders; None: those of scenes.py."""
    only: tuple[str, ...] = ()
    """Names of the scenes to run; all if none is given."""
    max_seconds: float = 90.0
    """Seconds of training a scene."""
    runs: tuple[Path, ...] = ()
    """Measure these run folders, and train nothing."""
    keep: Path | None = None
    """Keep the run folders here."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train and render."""
    results: Path | None = None
    """Folder for intervals.json and intervals.md; None: beside the benchmarks."""
    quick: bool = False
    """Three seconds of training on the first scene."""


def main(options: Options) -> None:
    """Measure every scene and publish."""
    seconds = 3.0 if options.quick else options.max_seconds
    measured: dict[str, Any] = {}
    with ExitStack() as stack:
        runs = list(options.runs)
        if not runs:
            folders = _common.scene_folders(options.scenes, options.only)[: 1 if options.quick else None]
            keep = options.keep or Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-intervals-"))
            )
            runs = [trained_on(folder, seconds, options.device, keep) for folder in folders]
        for run in runs:
            name, found = measure(run, options.device)
            measured[name] = found
            print(
                f"{name}: {found['abundances']['90']:.3f} of the abundances are in their 90 % intervals",
                flush=True,
            )
    setting = {
        "seconds of training": {
            name: round(found["training"]["seconds"]) for name, found in measured.items()
        },
        "device": options.device,
        "options": "those of the runs given"
        if options.runs
        else "defaults, but --pipeline.model.num-endmembers = number of materials",
        "index": "normalised difference of the bands at a quarter and three quarters",
    }
    report = _common.Report(
        "intervals",
        "How many true values lie in their intervals",
        setting,
        _machine.describe_machine(options.device),
        judged(measured),
        measured,
        (by_coverage(measured), by_material(measured), by_edge(measured)),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def trained_on(folder: Path, seconds: float, device: str, keep: Path) -> Path:
    """The run of a training on a scene."""
    count = len(json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["materials"])
    print(f"{folder.name}: training {seconds:g} s with {count} endmembers ...", flush=True)
    words = ["unmix-nerf", "--data", str(folder), "--device", device, "--max-seconds", f"{seconds:g}"]
    words += ["--output-dir", str(keep), "--pipeline.model.num-endmembers", str(count)]
    return _common.run_command([_common.console_script("unmix-train"), *words]).run


def measure(run: Path, device: str) -> tuple[str, dict[str, Any]]:
    """Scene name and figures of a run; ends with status 2 where the scene is gone or nothing is known of it."""
    loaded = load_run(run, device)
    scene, trained = find_scene(loaded.record.summary, run, None), loaded.materials_scene
    if scene is None or scene.endmembers is None:
        raise SystemExit(f"{run}: its scene is not where it was, or has no true endmembers")
    views = list(thinned_views(trained, MeasuredScene(scene, loaded.record.summary.get("illuminant"))))
    errors = measure_errors(trained, views)  # by this revision, as the end of a training does it
    trained = replace(trained, measured_errors=errors or "too few views")
    _ = trained.require_errors()  # which says why there are none
    counted = [of_view(trained, scene, index) for index in scene.eval_indices]
    joined = {key: np.concatenate([view[key] for view in counted]) for key in counted[0]}
    return scene.root.name, {**scores(joined, scene), **times(trained), "training": training_share(run)}


def of_view(trained: TrainedScene, scene: Scene, index: int) -> dict[str, np.ndarray]:
    """Of the pixels of a view with anything in them: errors, half widths and whether intervals hold the truth."""
    truth, view = view_truth(scene, index), trained.look(scene.cameras[index])
    known = scene_truth(scene)
    assert known.endmembers is not None
    assert truth.abundances is not None
    matching = match_endmembers(trained.materials.endmembers.cpu().double(), known.endmembers)
    seen = view.seen_places
    counts = truth.valid & (view.opacity.cpu() > _SEEN) & (truth.opacity > _OPAQUE)
    counts &= truth.abundances.sum(dim=-1) > _SEEN
    is_known = seen.errors.spectra.cpu().isfinite()
    found = {"is_known": is_known[counts].numpy(), "edge": edges(truth.abundances, counts)}
    counts &= is_known
    found["edge"] = edges(truth.abundances, counts)
    found["material"] = truth.abundances.argmax(dim=-1)[counts].numpy()
    own, true = list(matching.pred_ids), list(matching.true_ids)
    index_name = index_of(trained)
    score = trained.output(index_name).score
    assert score is not None
    number = score.fit(torch.empty(0, len(trained.bands)))
    measured = trained.materials.reflectance_of(
        truth.spectra.to(trained.device), truth.opacity.to(trained.device)
    )
    reflectance = trained.materials.reflectance(view.coefficients)
    asked = {
        "abundances": ("abundances", seen.abundances[..., own], truth.abundances[..., true]),
        "reflectance": ("reflectance", reflectance, measured),
        "index": (index_name, number(reflectance)[..., None], number(measured)[..., None]),
    }
    for key, (name, value, target) in asked.items():
        value, target = value.cpu()[counts], target.cpu()[counts]
        found[f"{key} error"] = (value - target).abs().numpy()
        if key == "abundances":
            found["there"] = (torch.maximum(value, target) > _THERE).numpy()
        for coverage in COVERAGES:
            low, high = (ends_.cpu() for ends_ in ends_of(name, trained)(seen, coverage))
            low, high = (one[..., own] if key == "abundances" else one for one in (low, high))
            low, high = (one[counts].view(len(value), -1) for one in (low, high))
            inside = (low - _ROUNDING <= target) & (target <= high + _ROUNDING)
            found[f"{key} {coverage:.0%}"] = inside.numpy()
            found[f"{key} half {coverage:.0%}"] = ((high - low) / 2).numpy()
    return found


def ends_of(name: str, trained: TrainedScene) -> Any:
    """Intervals of an output; of reflectance without a light those of radiance."""
    is_dark = name == "reflectance" and not trained.materials.is_light_known
    return interval_ends("spectral" if is_dark else name, trained.materials)


def index_of(trained: TrainedScene) -> str:
    """A normalised difference that the scene's bands reach."""
    nm = trained.bands.centers_nm
    first, second = nm[len(nm) // 4], nm[(3 * len(nm)) // 4]
    return f"index:(r{second:g}-r{first:g})/(r{second:g}+r{first:g})"


def edges(abundances: torch.Tensor, counts: torch.Tensor) -> np.ndarray:
    """Distance of pixels from the nearest pixel of another main material, in pixels."""
    labels = abundances.argmax(dim=-1).numpy()
    is_edge = np.zeros(labels.shape, dtype=bool)
    for axis in (0, 1):
        differs = np.diff(labels, axis=axis) != 0
        first, second = ([slice(None)] * 2 for _ in range(2))
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        is_edge[tuple(first)] |= differs
        is_edge[tuple(second)] |= differs
    distances = distance_transform_edt(~is_edge) if is_edge.any() else np.full(labels.shape, np.inf)
    return np.asarray(distances)[counts.numpy()]


def scores(joined: dict[str, np.ndarray], scene: Scene) -> dict[str, Any]:
    """Coverage, half width and rank correlation of each quantity."""
    there, found = joined["there"], {}
    for key in ("abundances", "abundances there", "reflectance", "index"):
        name = key.removesuffix(" there")
        chosen = there if key != name else np.isfinite(joined[f"{name} half 90%"])
        half, error = joined[f"{name} half 90%"][chosen], joined[f"{name} error"][chosen]
        some = np.random.default_rng(0).permutation(len(half))[:_MOST_RANKED]
        found[key] = {
            **{f"{c * 100:.0f}": float(joined[f"{name} {c:.0%}"][chosen].mean()) for c in COVERAGES},
            "half width": float(half.mean()),
            "error": float(error.mean()),
            "rank": float(np.asarray(spearmanr(half[some], error[some]))[0]),
            "values": len(half),
        }
    inside, edge = joined["abundances 90%"], joined["edge"]
    bounds = (-1.0, *_EDGE_PX, np.inf)
    found["by edge"] = {
        f"{low:g} to {high:g} px".replace("-1 to", "up to"): float(
            inside[(edge > low) & (edge <= high)][there[(edge > low) & (edge <= high)]].mean()
        )
        for low, high in pairwise(bounds)
        if there[(edge > low) & (edge <= high)].any()
    }
    names = scene.material_names or tuple(map(str, range(int(joined["material"].max()) + 1)))
    found["by material"] = {
        name: float(inside[joined["material"] == number][there[joined["material"] == number]].mean())
        for number, name in enumerate(names)
        if there[joined["material"] == number].any()
    }
    return {**found, "determined": float(joined["is_known"].mean())}


def times(trained: TrainedScene) -> dict[str, float]:
    """Time of a map with widths over that without, the median of five; and of a probe with intervals."""
    camera = trained.views[-1].camera
    ratios, probes = [], []
    for _ in range(5):
        started = time.perf_counter()
        view = trained.look(camera)
        _ = view["abundances"]
        rendered = time.perf_counter()
        _ = view["interval:abundance"]
        ratios.append((time.perf_counter() - started) / (rendered - started))
        probe = trained.probe(camera, camera.width // 2, camera.height // 2)
        started = time.perf_counter()
        _ = probe.interval(), trained.interval(probe, index_of(trained))
        probes.append(time.perf_counter() - started)
    return {"map over render": float(np.median(ratios)), "probe seconds": float(np.median(probes))}


def training_share(run: Path) -> dict[str, float]:
    """Seconds of training alone."""
    return {"seconds": json.loads((run / "training.json").read_text(encoding="utf-8"))["train_seconds"]}


def judged(measured: dict[str, Any]) -> list[_common.Figure]:
    """The lines of the table."""
    figures = []
    for key in ("abundances", "abundances there", "reflectance", "index"):
        covered = [values[key]["90"] for values in measured.values()]
        middle = float(np.median(covered))
        asked = f"{MEDIAN[0]:.2f} to {MEDIAN[1]:.2f}"
        figures += [
            _common.required(
                f"{key}: in 90 % intervals, median scene",
                asked,
                MEDIAN[0] <= middle <= MEDIAN[1],
                f"{middle:.3f}",
            ),
            WORST.judge(f"{key}: in 90 % intervals, worst scene", min(covered)),
            RANK.judge(
                f"{key}: rank correlation of width with error, median scene",
                float(np.median([values[key]["rank"] for values in measured.values()])),
            ),
        ]
    half = float(np.median([values["abundances"]["half width"] for values in measured.values()]))
    return [
        *figures,
        HALF_WIDTH.judge("mean half width of abundances, median scene", half),
        RENDER.judge(
            "a map of widths over a render, worst", max(v["map over render"] for v in measured.values())
        ),
        PROBE.judge("intervals of a probe, worst", max(v["probe seconds"] for v in measured.values())),
    ]


def by_coverage(measured: dict[str, Any]) -> _common.DetailTable:
    """Coverage, width and rank of each scene."""
    headers = ["scene", "of", *(f"{c:.0%}" for c in COVERAGES), "half width", "error", "rank", "determined"]
    rows = [
        [
            name,
            key,
            *(f"{values[key][f'{c * 100:.0f}']:.3f}" for c in COVERAGES),
            *(f"{values[key][what]:.3f}" for what in ("half width", "error", "rank")),
            f"{values['determined']:.3f}",
        ]
        for name, values in measured.items()
        for key in ("abundances", "abundances there", "reflectance", "index")
    ]
    return _common.DetailTable("Shares of true values in intervals", headers, rows)


def by_material(measured: dict[str, Any]) -> _common.DetailTable:
    """Coverage where each material is the main one."""
    rows = [
        [name, material, f"{share:.3f}"]
        for name, values in measured.items()
        for material, share in values["by material"].items()
    ]
    return _common.DetailTable(
        "Abundances there, in 90 % intervals, by main material", ["scene", "material", "share"], rows
    )


def by_edge(measured: dict[str, Any]) -> _common.DetailTable:
    """Coverage by distance from edges of materials."""
    distances = list(dict.fromkeys(key for values in measured.values() for key in values["by edge"]))
    rows = [
        [name, *(f"{values['by edge'][key]:.3f}" if key in values["by edge"] else "" for key in distances)]
        for name, values in measured.items()
    ]
    return _common.DetailTable(
        "Abundances there, in 90 % intervals, by distance from edges", ["scene", *distances], rows
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
