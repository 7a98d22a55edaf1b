"""Does training work in an unbounded world: objects as good as alone, and no fog before the cameras?

    python benchmarks/world.py [--steps 2400] [--runs FOLDER]

Trains the demo scene's table three times with as many steps: alone (with alpha), on a ground under a sky, and in a room
with windows, the last two without alpha. The room is trained as a bounded scene too, which shows what the world is
worth. Fog is the opacity that rays of evaluation views meet before 93 % of the distance to the true first surface.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import torch
import tyro

RUNS: dict[str, tuple[str, str]] = {
    "table": ("table", "auto"),
    "world": ("world", "auto"),
    "room": ("room", "auto"),
    "room, bounded": ("room", "bounded"),
}
"""Place and `--world` of each run."""
SURFACE_SHARE = 0.93
"""Of the distance to the true surface; density up to it is fog."""
LIMITS = {"psnr": _common.Limit(-1.0, unit=" dB"), "fog": _common.Limit(0.05, 0.02, is_upper=True)}
_CHUNK = 8192


@dataclass(frozen=True)
class Options:
    """Train in an unbounded world."""

    steps: int = 2400
    """Of each training."""
    only: tuple[str, ...] = tuple(RUNS)
    """Runs to make."""
    runs: Path | None = None
    """Keep scenes, run folders and figures here; runs whose figures are here aren't made again."""
    results: Path | None = None
    """Folder for world.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Ten steps on small views."""


def main(options: Options) -> None:
    """Measure every run and publish."""
    machine, measured = _machine.describe_machine("cpu"), {}
    with tempfile.TemporaryDirectory(prefix="unmix-world-") as folder:
        place = options.runs or Path(folder)
        size, views = ("32", "16") if options.quick else ("64", "32")
        place.mkdir(parents=True, exist_ok=True)
        steps = 10 if options.quick else options.steps
        for name in {RUNS[run][0] for run in options.only}:
            words = ["--place", name, "--size", size, "--views", views, "--overwrite"]
            _common.run_command([_common.console_script("unmix-demo-scene"), str(place / name), *words])
        for run in options.only:
            figures = place / f"{run}, {steps} steps, {size} px.json"
            if not figures.exists():
                figures.write_text(json.dumps(measure(run, steps, place)), encoding="utf-8")
            measured[run] = json.loads(figures.read_text(encoding="utf-8"))
    setting = {"steps": steps, "pixels": f"{size} x {size}", "views": views, "defaults": "all others"}
    rows = [[run, *(f"{value:.3f}" for value in found.values())] for run, found in measured.items()]
    details = _common.DetailTable("All runs", ["run", *next(iter(measured.values()))], rows)
    question = "Objects in an unbounded world against the same objects alone, at equal steps"
    report = _common.Report("world", question, setting, machine, judge(measured), measured, (details,))
    _common.publish(report, _common.results_folder(options.results, options.quick))


def measure(run: str, steps: int, place: Path) -> dict[str, float]:
    """Train, evaluate, and look at what is in front of the surfaces."""
    name, world = RUNS[run]
    print(f"{run}: training ...", flush=True)
    words = ["--max-num-iterations", str(steps)]
    words += ["--world", world, "--device", "cpu", "--output-dir", str(place / "runs")]
    train, evaluate = (_common.console_script(f"unmix-{word}") for word in ("train", "eval"))
    folder = _common.run_command([train, "unmix-nerf", "--data", str(place / name), *words]).run
    _common.run_command([evaluate, "--run", str(folder), "--device", "cpu"])
    metrics = json.loads((folder / "eval" / "metrics.json").read_text(encoding="utf-8"))
    objects, fog = look(folder, name, place)
    kept = {key: metrics[key] for key in ("psnr", "sam", "miou", "train_seconds")}
    found = {**kept, "psnr of the objects": objects, "fog": fog}
    print(f"{run}: {found}", flush=True)
    return found


def look(run: Path, name: str, place: Path) -> tuple[float, float]:
    """PSNR over the pixels of the objects, and fog: means over the evaluation views."""
    from unmix_plugin import open_run
    from unmix_plugin.scenes.demo.scene import PLACES
    from unmix_plugin.scenes.demo.shading import THINGS
    from unmix_plugin.scenes.demo.shapes import first_hits
    from unmix_plugin.scenes.reading.loader import load_scene
    from unmix_plugin.trained.evaluation import render_view

    scene: Any = open_run(run)
    truth = load_scene(place / name)
    placements, psnr, fog = [thing.placement for thing in PLACES[name].things], [], []
    cameras = {view.name: view.camera for view in scene.views}
    for index in truth.eval_indices:
        camera = cameras[truth.frames[index].name]
        rays = camera.image_rays(0)
        origins = scene.frame.to_world(rays.origins.double().numpy()).astype(np.float32)
        directions = (rays.directions.numpy() @ scene.frame.rotation).astype(np.float32)
        distances, nearest = first_hits(placements, origins, directions)
        is_object = torch.from_numpy(np.isfinite(distances) & (nearest < len(THINGS)))
        spectra = render_view(scene, camera).spectra.clamp(0, 1).flatten(0, 1)
        errors = (spectra - torch.from_numpy(truth.cube(index)).flatten(0, 1)).square()
        psnr.append(-10 * float(torch.log10(errors[is_object].mean())))
        limits = torch.from_numpy(distances).clamp(max=1e6) * (SURFACE_SHARE * scene.frame.scale)
        fog.append(float(opacity_before(scene, rays, limits).mean()))
    return float(np.mean(psnr)), float(np.mean(fog))


@torch.no_grad()
def opacity_before(scene: Any, rays: Any, limits: torch.Tensor) -> torch.Tensor:
    """Share of its light that each ray loses before a distance in model units."""
    parts = []
    for first in range(0, len(rays), _CHUNK):
        bundle = rays[first : first + _CHUNK]
        found = scene.renderer.render(scene.field, bundle)
        points = scene.renderer.space.from_unit(found.positions)
        t = (points - bundle.origins[found.ray_indices]).norm(dim=-1)
        counted = found.weights * (t < limits[first : first + _CHUNK][found.ray_indices])
        parts.append(torch.zeros(len(bundle)).index_add(0, found.ray_indices, counted))
    return torch.cat(parts)


def judge(measured: dict[str, dict[str, float]]) -> list[_common.Figure]:
    """What is asked of the world, and what the room shows."""
    figures = []
    if {"table", "world"} <= set(measured):
        gain = measured["world"]["psnr of the objects"] - measured["table"]["psnr of the objects"]
        figures.append(LIMITS["psnr"].judge("PSNR of the objects, world less table alone", gain))
        figures.append(
            LIMITS["fog"].judge("world: opacity before the first surface", measured["world"]["fog"])
        )
    for run in ("room", "room, bounded"):
        if run in measured:
            found = measured[run]
            figures.append(_common.reported(run, f"{found['psnr']:.2f} dB, fog {found['fog']:.3f}"))
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
