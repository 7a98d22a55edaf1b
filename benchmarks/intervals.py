"""How often do intervals hold what is true, and how wide are they?

    python benchmarks/intervals.py [--only table room] [--steps 2000]
    python benchmarks/intervals.py --runs RUN ... --landscapes 10 --image samson_dataset.mat

Trains on scenes with true abundances by the command that a user would give, and asks in all evaluation views how many
true values lie in intervals of 50, 80, 90 and 95 %: of abundances, of reflectance (radiance where the light is unknown)
and of an index, which both views measured; of endmembers, as bright as the run has them; and of the area of each
material on the run's own surface, whose true materials the evaluation views tell. Abundances are counted twice: all,
and those that are there (predicted or true above 0.05), since nearly every interval holds the 0 of a material that is
absent. Nothing is fitted to the evaluation views. One to three minutes a scene; `--runs FOLDER` measures runs that are
there, with errors as this revision measures them at the end of a training.

Images are unmixed by `unmix_image` with the true number of materials: landscapes of odd number, by which nothing was
chosen, and a .mat file as in unmixing_2d.py.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
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
from _landscapes import landscape
from _unmixing_mat import read_mat
from scipy.ndimage import distance_transform_edt
from scipy.stats import spearmanr

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.intervals import Interval
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.spectral.unmixing.image import unmix_image
from unmix_plugin.trained.evaluation import scene_truth, view_truth
from unmix_plugin.trained.measured_errors import measure_errors
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.open_run import find_scene, load_run
from unmix_plugin.trained.outputs import interval_ends
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.regions import OfMaterial
from unmix_plugin.trained.surface import SeenSurface, in_image
from unmix_plugin.trained.surface_mesh import vertex_areas
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
QUANTITIES = ("abundances", "abundances there", "reflectance", "index", "endmembers")
_MOST_RANKED = 200_000


@dataclass(frozen=True)
class Options:
    """Train and count."""

    scenes: Path | None = None
    """Folder of scene folders; None: those of scenes.py."""
    only: tuple[str, ...] = ()
    """Names of the scenes to run; all if none is given."""
    steps: int = 2000
    """Of training a scene: figures are those of any machine."""
    runs: tuple[Path, ...] = ()
    """Measure these run folders, and train nothing."""
    landscapes: int = 10
    """Of odd number, the first so many; 0: none."""
    image: Path | None = None
    """A .mat file with true abundances, such as that of Samson."""
    keep: Path | None = None
    """Keep the run folders here."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train and render."""
    results: Path | None = None
    """Folder for intervals.json and intervals.md; None: beside the benchmarks."""
    quick: bool = False
    """A hundred steps on the first scene."""


def main(options: Options) -> None:
    """Measure every scene and publish."""
    steps = 100 if options.quick else options.steps
    measured: dict[str, Any] = {}
    with ExitStack() as stack:
        runs = list(options.runs)
        if not runs:
            folders = _common.scene_folders(options.scenes, options.only)[: 1 if options.quick else None]
            keep = options.keep or Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-intervals-"))
            )
            runs = [trained_on(folder, steps, options.device, keep) for folder in folders]
        for run in runs:
            name, found = measure(run, options.device)
            measured[name] = found
            covered = found["abundances"]["90"]
            print(f"{name}: {covered:.3f} of the abundances are in their 90 % intervals", flush=True)
    images = {f"landscape-{number}": landscape(number) for number in range(1, 2 * options.landscapes, 2)}
    images = dict(list(images.items())[: 1 if options.quick else None])
    for name, one in images.items():
        try:
            measured[name] = scores(of_image(one.pixels, one.abundances, one.endmembers), one.names)
        except SpectrumError as error:
            print(f"{name}: refused: {error}", flush=True)
            continue
        print(f"{name}: done", flush=True)
    if options.image is not None:
        pixels, abundances, endmembers = (one.numpy() for one in read_mat(options.image))
        names = [str(number) for number in range(len(endmembers))]
        measured[options.image.stem] = scores(of_image(pixels, abundances, endmembers), names)
    setting = {
        "steps of training": {name: found["steps"] for name, found in measured.items() if "steps" in found},
        "device": options.device,
        "options": "those of the runs given"
        if options.runs
        else "defaults, but --pipeline.model.num-endmembers = number of materials",
        "images": "true number of materials",
        "index": "normalised difference of the bands at a quarter and three quarters",
    }
    report = _common.Report(
        "intervals",
        "How many true values lie in their intervals",
        setting,
        _machine.describe_machine(options.device),
        judged(measured),
        measured,
        (by_coverage(measured), by_material(measured), by_edge(measured), by_area(measured)),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def trained_on(folder: Path, steps: int, device: str, keep: Path) -> Path:
    """The run of a training on a scene."""
    count = len(json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["materials"])
    print(f"{folder.name}: training {steps} steps with {count} endmembers ...", flush=True)
    words = ["unmix-nerf", "--data", str(folder), "--device", device, "--max-num-iterations", str(steps)]
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
    names = scene.material_names or [str(number) for number in range(len(trained.materials.names))]
    joined |= of_endmembers(
        trained.endmember_interval, trained.materials.endmembers, scene_truth(scene).endmembers
    )
    found = {
        **scores(joined, names),
        **times(trained),
        "steps": json.loads((run / "training.json").read_text(encoding="utf-8"))["steps"],
    }
    return scene.root.name, found | {"area": areas(trained, scene, names)}


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
        order = own if key == "abundances" else slice(None)

        def ends(coverage: float, name: str = name, order: Any = order) -> list[np.ndarray]:
            both = (one.cpu() for one in ends_of(name, trained)(seen, coverage))
            return [(one if one.dim() == 3 else one[..., None])[..., order][counts].numpy() for one in both]

        found |= counted(key, value.numpy(), target.numpy(), ends)
    return found


Ends = Callable[[float], Sequence[np.ndarray]]
"""From a coverage to low and high ends."""


def counted(key: str, values: np.ndarray, true: np.ndarray, ends: Ends) -> dict[str, np.ndarray]:
    """Errors of values, half widths, and whether intervals hold what is true."""
    found = {f"{key} error": np.abs(values - true)}
    if key == "abundances":
        found["there"] = np.maximum(values, true) > _THERE
    for coverage in COVERAGES:
        low, high = ends(coverage)
        found[f"{key} {coverage:.0%}"] = (low - _ROUNDING <= true) & (true <= high + _ROUNDING)
        found[f"{key} half {coverage:.0%}"] = (high - low) / 2
    return found


def of_endmembers(
    interval: Callable[[float], Interval], found: torch.Tensor, true: torch.Tensor | None
) -> dict[str, np.ndarray]:
    """Of endmembers that are matched to true ones, these as bright as those, with errors relative to their length."""
    assert true is not None
    matching = match_endmembers(found.cpu().double(), true.double())
    own = found.cpu().double()[list(matching.pred_ids)]
    lengths = own.square().mean(dim=1, keepdim=True).sqrt()
    target = true.double()[list(matching.true_ids)]
    target = target / target.square().mean(dim=1, keepdim=True).sqrt()

    def ends(coverage: float) -> list[np.ndarray]:
        both = interval(coverage)
        return [one[list(matching.pred_ids)] / lengths.numpy() for one in (both.low, both.high)]

    return counted("endmembers", (own / lengths).numpy(), target.numpy(), ends)


def of_image(pixels: np.ndarray, abundances: np.ndarray, endmembers: np.ndarray) -> dict[str, np.ndarray]:
    """Of an image alone, (N, B), unmixed with defaults; as a square where it is one, for distances from edges."""
    side = round(len(pixels) ** 0.5)
    height, width = (side, side) if side**2 == len(pixels) else (1, len(pixels))
    unmixed = unmix_image(pixels.reshape(height, width, -1).astype(np.float32), len(endmembers))
    true = torch.from_numpy(abundances)
    matching = match_endmembers(torch.from_numpy(unmixed.endmembers).double(), torch.from_numpy(endmembers))
    own, order = list(matching.pred_ids), list(matching.true_ids)
    counts = torch.from_numpy(unmixed.abundances.sum(axis=-1) > 0)
    rows = counts.numpy()

    def ends(coverage: float) -> list[np.ndarray]:
        both = unmixed.interval(coverage)
        return [one[rows][:, own] for one in (both.low, both.high)]

    target = true.reshape(height, width, -1)
    return {
        "is_known": np.asarray(np.isfinite(unmixed.interval().low[rows]).all(axis=1)),
        "edge": edges(target, counts) if height > 1 else np.full(int(rows.sum()), np.nan),
        "material": target.argmax(dim=-1)[counts].numpy(),
        **counted("abundances", unmixed.abundances[rows][:, own], target[counts].numpy()[:, order], ends),
        **of_endmembers(
            unmixed.endmember_interval, torch.from_numpy(unmixed.endmembers), torch.from_numpy(endmembers)
        ),
    }


def areas(trained: TrainedScene, scene: Scene, names: Sequence[str]) -> dict[str, Any]:
    """Of each material: the part of the surface where it is the largest, its interval, and what is true of the places
    that evaluation views show; of the others the run is believed. Square units of the world."""
    surface = MeasuredSurface.of(trained)
    positions = torch.from_numpy(surface.mesh.vertices).float()
    of_vertex = vertex_areas(surface.areas, surface.mesh.faces, len(positions))
    votes = torch.zeros(len(positions), len(names))
    for index in scene.eval_indices:
        camera, truth = scene.cameras[index], view_truth(scene, index)
        assert truth.abundances is not None
        inside, coords, _ = in_image(camera, positions)
        seen = SeenSurface(trained, camera.width * camera.height, [camera]).shows(positions[inside])
        columns, rows = coords[seen].long().unbind(dim=1)
        votes[inside.nonzero()[seen, 0]] += truth.abundances[rows, columns].float()
    true_endmembers = scene_truth(scene).endmembers
    assert true_endmembers is not None
    matching = match_endmembers(trained.materials.endmembers.cpu().double(), true_endmembers)
    found, is_told = {}, votes.sum(dim=1) > _SEEN
    for own, true in zip(matching.pred_ids, matching.true_ids, strict=True):
        try:
            measured = surface.measure(OfMaterial(own), names[true])
        except ConfigError:  # it is the largest nowhere
            continue
        is_true = ((votes.argmax(dim=1) == true) & is_told).numpy()
        target = float(of_vertex[is_true].sum() + measured.vertex_areas[~is_told.numpy()].sum())
        interval = measured.area_interval
        ends = None if interval.not_determined else [float(interval.low), float(interval.high)]
        found[names[true]] = {"area": measured.area, "true": target, "interval": ends}
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


def scores(joined: dict[str, np.ndarray], names: Sequence[str]) -> dict[str, Any]:
    """Coverage, half width and rank correlation of each quantity, of what is determined."""
    there, found = joined["there"] & np.isfinite(joined["abundances half 90%"]), {}
    for key in QUANTITIES:
        name = key.removesuffix(" there")
        if f"{name} error" not in joined:
            continue
        chosen = np.isfinite(joined[f"{name} half 90%"]) & np.isfinite(joined[f"{name} error"])
        if not chosen.any():
            continue
        if key != name:
            chosen &= there
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


def judged(measured: dict[str, Any]) -> list[_common.Figure]:
    """The lines of the table."""
    figures = []
    for key in QUANTITIES:
        having = [values[key] for values in measured.values() if key in values]
        covered = [values["90"] for values in having]
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
                float(np.median([values["rank"] for values in having])),
            ),
        ]
    half = float(np.median([values["abundances"]["half width"] for values in measured.values()]))
    told = [one for values in measured.values() for one in values.get("area", {}).values()]
    inside = [one["interval"][0] <= one["true"] <= one["interval"][1] for one in told if one["interval"]]
    figures.append(
        _common.required(
            "areas of materials in 90 % intervals, all scenes",
            "0.86 to 0.94",
            bool(MEDIAN[0] <= np.mean(inside) <= MEDIAN[1]),
            f"{sum(inside)} of {len(inside)}",
        )
    )
    times_ = [values for values in measured.values() if "map over render" in values]
    return [
        *figures,
        HALF_WIDTH.judge("mean half width of abundances, median scene", half),
        RENDER.judge("a map of widths over a render, worst", max(v["map over render"] for v in times_)),
        PROBE.judge("intervals of a probe, worst", max(v["probe seconds"] for v in times_)),
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
        for key in QUANTITIES
        if key in values
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


def by_area(measured: dict[str, Any]) -> _common.DetailTable:
    """The area of each material beside its interval and what is true."""
    rows = [
        [
            name,
            material,
            f"{one['area']:.4g}",
            f"{one['interval'][0]:.4g} to {one['interval'][1]:.4g}" if one["interval"] else "not determined",
            f"{one['true']:.4g}",
        ]
        for name, values in measured.items()
        for material, one in values.get("area", {}).items()
    ]
    headers = ["scene", "material", "area", "90 % interval", "true"]
    return _common.DetailTable("Areas of materials, square units", headers, rows)


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
